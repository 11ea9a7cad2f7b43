"""Labels of a sequence: optical flow between neighbouring frames, what frames see in common, highlights' identities."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from simtest.rendering import HighlightPoint, Session
from simtest.runtime.array_files import write_arrays
from simtest.runtime.arrays import Array, Picture
from simtest.runtime.files import Json, write_atomically, write_json
from simtest.simulation.deforming import SurfaceOverTime, moved_between
from simtest.simulation.flow import STATES, SeenSurface, flow_between, hides
from simtest.simulation.flow_picture import flow_picture
from simtest.simulation.rendered_view import RenderedView
from simtest.simulation.tracks import Tracks
from simtest.simulation.view_files import thumbnail, write_sheet
from simtest.spec import Scene

STRIDE_PX = 16
"""Co-visibility of frames that are no neighbours is that of every so many pixels along both axes."""

MOST_APART = 32
"""Frames farther apart than this are not compared."""

COVISIBILITY, TRACKS, FLOW_SHEET = "covisibility.npy", "tracks.json", "flow_sheet.png"

FIELDS = {
    "flow_NNNN.npz": "from frame NNNN to the next: forward, backward (float32, (H, W, 2), px) and their states "
    "(forward_state, backward_state, uint8, (H, W))",
    "forward": "where the surface point at each pixel's centre lies in the next frame, less that centre, px; also "
    "where it is not seen there; NaN off the surface and on instruments. backward: from the next frame to this one, "
    "at the next frame's pixels",
    "states": ", ".join(f"{number}: {name}" for number, name in enumerate(STATES)),
    "covisibility.npy": "float32, (N, N): share of the surface points of frame i that frame j sees, on every "
    f"{STRIDE_PX}th pixel; NaN for frames more than {MOST_APART} apart, and for j < i where the surface deforms",
    "flow_sheet.png": "the forward flow of each frame: hue its direction, saturation its length, dark what the next "
    "frame does not see; the wheel is the key",
    "highlights": "of each frame, in the order of the identities: bp_px, position_world_mm, normal_world, light, lit, "
    "isolated, kd_min, kd_max, and identity: the index in tracks",
    "tracks": "first_frame, and in each frame of the track: entries (index in the frame's highlights), bp_px, "
    "position_world_mm; birth and death: sequence (its first or last frame), frame border, merged or split (at a fold, "
    "where two highlights become one and vanish, or are born), hidden (behind another part of the surface), off the "
    "surface, not found, not followed",
    "base": "the same for the highlights of the base, without the relief; on a smooth surface they are those of the "
    "fine surface, and this is null",
}
"""What the files hold; tracks.json repeats it."""


@dataclass(frozen=True)
class _Frame:
    """What is kept of a frame for those that follow."""

    scene: Scene
    seen: SeenSurface
    sparse: Array


class SequenceLabels:
    """Writes the labels of a sequence whose frames are added in order.

    Parameters
    ----------
    folder : Path
        An existing folder; the labels of an earlier call are removed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._frames: list[_Frame] = []
        self._shares: dict[tuple[int, int], float] = {}
        self._time = SurfaceOverTime()
        self._fine, self._base = (Tracks(fine, self._time.between) for fine in (True, False))
        self._listed: list[Json] = []
        self._listed_base: list[Json] = []
        self._pictures: list[Picture] = []
        for old in (*folder.glob("flow_*.npz"), folder / COVISIBILITY, folder / TRACKS, folder / FLOW_SHEET):
            old.unlink(missing_ok=True)

    def add(self, session: Session, view: RenderedView) -> None:
        """Add the next frame: the session is at its scene."""
        # Flow to and from the last frame.
        seen = SeenSurface.of(session)
        points = seen.position[STRIDE_PX // 2 :: STRIDE_PX, STRIDE_PX // 2 :: STRIDE_PX].reshape(-1, 3)
        frame = _Frame(view.scene, seen, points[np.isfinite(points[:, 0])])
        if self._frames:
            self._write_flow(session, self._frames[-1], frame)
        self._frames.append(frame)
        self._compare(session)
        if len(self._frames) > 1:
            # Only sparse points of earlier frames are needed further.
            last = self._frames[-2]
            empty = SeenSurface(last.seen.camera, last.seen.world_from_camera, np.empty((0, 0, 3)))
            self._frames[-2] = _Frame(last.scene, empty, last.sparse)
        # Identities.
        self._listed.append(_listed(session, view.highlights, self._fine.add(session, view.highlights)))
        if session.surface.relief is not None:
            self._listed_base.append(_listed(session, view.clouds, self._base.add(session, view.clouds)))
        self._time.time_s = view.scene.time_s

    def _write_flow(self, session: Session, last: _Frame, new: _Frame) -> None:
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
        path = self._folder / f"flow_{len(self._frames) - 1:04d}.npz"
        write_atomically(path, lambda part: write_arrays(part, arrays))

    def _compare(self, session: Session) -> None:
        """Compare the newest frame with those before it, both ways, on sparse points."""
        new = len(self._frames) - 1
        earlier = range(max(0, new - MOST_APART), new)
        pairs = [(old, new) for old in earlier]
        if not session.scene.deformation:
            pairs += [(new, old) for old in earlier]
        # All rays of a frame in one launch.
        inside, centres = [], []
        for i, j in pairs:
            points, other = self._frames[i].sparse, self._frames[j].seen
            if moved := moved_between(session, self._frames[i].scene.time_s, self._frames[j].scene.time_s):
                points = moved(points)
            with np.errstate(invalid="ignore"):
                inside.append(points[other.camera.contains(other.project(points))])
            centres.append(np.broadcast_to(other.world_from_camera[:3, 3], inside[-1].shape))
        if not pairs:
            return
        hidden = hides(session, np.concatenate(centres), np.concatenate(inside))
        ends = np.cumsum([len(points) for points in inside])
        for (i, j), own in zip(pairs, np.split(hidden, ends[:-1]), strict=True):
            whole = len(self._frames[i].sparse)
            self._shares[i, j] = float(np.count_nonzero(~own) / whole) if whole else float("nan")

    def close(self) -> list[Path]:
        """Write covisibility.npy and tracks.json; return all files of the labels."""
        count = len(self._frames)
        shares = np.full((count, count), np.nan, dtype=np.float32)
        np.fill_diagonal(shares, 1.0)
        for (i, j), share in self._shares.items():
            shares[i, j] = share
        files = [self._folder / COVISIBILITY, self._folder / TRACKS]

        def save(part: Path) -> None:
            with part.open("wb") as file:
                np.save(file, shares, allow_pickle=False)

        write_atomically(files[0], save)
        rough = bool(self._listed_base)
        base: Json = {"highlights": self._listed_base, "tracks": self._base.to_json()} if rough else None
        fields = cast(Json, FIELDS)
        table = {"fields": fields, "highlights": self._listed, "tracks": self._fine.to_json(), "base": base}
        write_json(files[1], table, compact=True)
        if self._pictures:
            files.append(self._folder / FLOW_SHEET)
            write_sheet(files[-1], self._pictures)
        return [*sorted(self._folder.glob("flow_*.npz")), *files]


def _listed(session: Session, highlights: Sequence[HighlightPoint], identities: list[int]) -> Json:
    """Return a frame's highlights as JSON, in the world's frame."""
    rotation = session.surface.model_from_camera[:3, :3]
    positions = session.to_model(np.array([h.position for h in highlights]).reshape(-1, 3))
    return [
        {
            "identity": identity,
            "light": highlight.light,
            "bp_px": highlight.bp_px.tolist(),
            "position_world_mm": position.tolist(),
            "normal_world": (rotation @ highlight.normal).tolist(),
            "kd_min": highlight.kd_min,
            "kd_max": highlight.kd_max,
            "lit": highlight.lit,
            # Points of the base are not judged.
            "isolated": getattr(highlight, "isolated", None),
        }
        for highlight, position, identity in zip(highlights, positions, identities, strict=True)
    ]
