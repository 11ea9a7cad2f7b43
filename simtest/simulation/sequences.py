"""Labels of a sequence: optical flow between neighbouring frames, and what frames see in common."""

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtest.rendering import Session
from simtest.runtime.arrays import Array, Picture, write_arrays
from simtest.runtime.files import write_atomically
from simtest.simulation.flow import SeenSurface, flow_between, flow_picture, hides, moved_between
from simtest.simulation.frame import RenderedView
from simtest.simulation.frame_files import thumbnail, write_sheet
from simtest.spec import Scene

STRIDE_PX = 16
"""Co-visibility of frames that are no neighbours is that of every so many pixels along both axes."""

MOST_APART = 32
"""Frames farther apart than this are not compared."""

COVISIBILITY, FLOW_SHEET = "covisibility.npy", "flow_sheet.png"

FILES = ("flow_*.npz", COVISIBILITY, FLOW_SHEET)
"""What is written, as patterns; docs/howto/scenes.md says what it holds."""


@dataclass(frozen=True)
class _LabelledMoment:
    """What is kept of a frame for those that follow: its points on the stride's pixels, without instruments."""

    number: int
    scene: Scene
    seen: SeenSurface
    sparse: Array


class SequenceLabels:
    """Writes the labels of a sequence, whose frames are added in order, into an existing folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._frames: deque[_LabelledMoment] = deque(maxlen=MOST_APART)
        self._count = 0
        self._shares: dict[tuple[int, int], float] = {}
        self._pictures: list[Picture] = []

    def add(self, session: Session, view: RenderedView) -> None:
        """Add the next frame: the session is at its scene."""
        seen = SeenSurface.of(session)
        points = seen.tissue[STRIDE_PX // 2 :: STRIDE_PX, STRIDE_PX // 2 :: STRIDE_PX].reshape(-1, 3)
        frame = _LabelledMoment(self._count, view.scene, seen, points[np.isfinite(points[:, 0])])
        if self._frames:
            last = self._frames.pop()
            self._write_flow(session, last, frame)
            # Only sparse points of earlier frames are needed further.
            self._frames.append(replace(last, seen=replace(last.seen, position=np.empty((0, 0, 3)))))
        self._compare(session, frame)
        self._frames.append(frame)
        self._count += 1

    def _write_flow(self, session: Session, last: _LabelledMoment, new: _LabelledMoment) -> None:
        times = last.scene.time_s, new.scene.time_s
        there, back = moved_between(session, *times), moved_between(session, *times[::-1])
        forward = flow_between(session, last.seen, new.seen, there)
        if back is not None:
            # The last frame's camera looks at the surface of its own moment.
            session.update(last.scene)
        backward = flow_between(session, new.seen, last.seen, back)
        if back is not None:
            session.update(new.scene)
        arrays: dict[str, npt.NDArray[np.generic]] = {
            "forward": forward.flow_px.astype(np.float32),
            "forward_state": forward.state,
            "backward": backward.flow_px.astype(np.float32),
            "backward_state": backward.state,
        }
        self._pictures.append(thumbnail(flow_picture(forward)))
        path = self._folder / f"flow_{last.number:04d}.npz"
        write_atomically(path, lambda part: write_arrays(part, arrays))

    def _compare(self, session: Session, new: _LabelledMoment) -> None:
        """Compare the newest frame with those before it, both ways, on sparse points."""
        pairs = [(old, new) for old in self._frames]
        if not session.scene.deformation:
            pairs += [(new, old) for old in self._frames]
        if not pairs:
            return
        # All rays of a frame in one launch.
        inside, centres = [], []
        for first, second in pairs:
            points = first.sparse
            if moved := moved_between(session, first.scene.time_s, second.scene.time_s):
                points = moved(points)
            inside.append(points[second.seen.shows(second.seen.project(points))])
            centres.append(np.broadcast_to(second.seen.world_from_camera[:3, 3], inside[-1].shape))
        hidden = hides(session, np.concatenate(centres), np.concatenate(inside))
        ends = np.cumsum([len(points) for points in inside])
        for (first, second), behind in zip(pairs, np.split(hidden, ends[:-1]), strict=True):
            whole = len(first.sparse)
            share = float(np.count_nonzero(~behind) / whole) if whole else float("nan")
            self._shares[first.number, second.number] = share

    def close(self) -> None:
        """Write covisibility.npy and flow_sheet.png."""
        shares = np.full((self._count, self._count), np.nan, dtype=np.float32)
        np.fill_diagonal(shares, 1.0)
        for pair, share in self._shares.items():
            shares[pair] = share

        def save(part: Path) -> None:
            with part.open("wb") as file:
                np.save(file, shares, allow_pickle=False)

        write_atomically(self._folder / COVISIBILITY, save)
        if self._pictures:
            write_sheet(self._folder / FLOW_SHEET, self._pictures)
