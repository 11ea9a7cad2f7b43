"""Views of an anatomy that show isolated highlights, or along its camera path, and the folder of `simtest views`.

A viewpoint is a number, where ``surface.view`` is auto, or else a share of the camera path. Those that are left out are
counted by reason. The folder holds a picture of each view, a sheet of all, their poses in several formats, and of a
sequence a film and labels.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.rendering import Progress, Session
from simtest.runtime.arrays import Array, Picture
from simtest.runtime.files import Json, write_atomically, write_json
from simtest.simulation import sequences
from simtest.simulation.frame import RenderedView, render_view
from simtest.simulation.frame_files import encoded_png, thumbnail, write_sheet
from simtest.simulation.highlights import REMEDIES, why_none
from simtest.simulation.sensor import to_uint8
from simtest.spec import AnatomySurface, Scene
from simtest.spec.camera_formats.trajectories import COLMAP, TRANSFORMS, TUM, Trajectory, stack, write_trajectory
from simtest.surfaces import make_surface

NO_ROOM = "no room for the camera, a light or an instrument"

GOLDEN_SHARE = 0.6180339887498949
"""Multiples of it, modulo 1, cover [0, 1) evenly at any number of them."""

FRAMES_PER_SECOND, FPS = 25.0, (0.1, 1000.0)
"""Of a sequence whose frame rate is not given, and those that it may have."""

FILM, PART = "film.avi", ".film.part.avi"
"""The film, and its name until it is finished: OpenCV knows its format by the suffix."""

WRITTEN = (
    "view_*.png", "sheet.png", FILM, PART, "views.json", TUM, TRANSFORMS,
    *(f"{COLMAP}/{name}.txt" for name in ("cameras", "images", "points3D")), *sequences.FILES,
)  # fmt: skip
"""What the folder may hold, as patterns: that of an earlier call is removed."""


@dataclass(frozen=True)
class SampledView:
    """A view that was kept, and how many isolated highlights it shows.

    The viewpoint is a number or a share of the camera path, and the pose, shape (4, 4), mm, in the world of the
    surface's own frame. `noise_seed` is that of its picture's file; `time_s`, when it is seen, None outside a sequence.
    """

    viewpoint: int | float
    isolated_highlights: int
    world_from_camera: Array
    picture: str | None = None
    noise_seed: int | None = None
    time_s: float | None = None

    def to_json(self, key: str) -> dict[str, Json]:
        """Return the entry of views.json; `key` is the viewpoint's key path."""
        pose = self.world_from_camera.tolist()
        # The second is the older name of the same pose.
        poses: dict[str, Json] = {"world_from_camera": pose, "model_from_camera": pose}
        more: dict[str, Json] = {"time_s": self.time_s, "picture": self.picture, "sensor.seed": self.noise_seed}
        given = {name: value for name, value in more.items() if value is not None}
        return {key: self.viewpoint, "isolated_highlights": self.isolated_highlights, **poses, **given}


@dataclass(frozen=True)
class SampledViews:
    """Views that show isolated highlights, and why others do not.

    Parameters
    ----------
    views : list of SampledView
        In the order tried.
    rejected : dict
        Number of viewpoints left out by reason: `NO_ROOM`, `NO_HIGHLIGHT`, or why the highlight of the view that stands
        out most is not isolated (theory.md section 6).
    poses_left_out : tuple of str
        Why the poses were not written in a format: it lacks the camera's lens.
    """

    views: list[SampledView]
    rejected: dict[str, int]
    poses_left_out: tuple[str, ...] = ()

    @property
    def tried(self) -> int:
        """How many viewpoints were tried."""
        return len(self.views) + sum(self.rejected.values())

    @property
    def remedy(self) -> str:
        """What to change where most views show no isolated highlight, for the most frequent reason; else empty."""
        if sum(view.isolated_highlights > 0 for view in self.views) > self.tried / 2 or not self.rejected:
            return ""
        # The most frequent reason is the first.
        return REMEDIES.get(next(iter(self.rejected)), "")


def sample_into(
    folder: Path, scene: Scene, count: int, viewpoints: Iterable[int | float], variant: str | None,
    progress: Progress | None, sequence: bool, fps: float | None = None, labels: bool = False,
) -> SampledViews:  # fmt: skip
    """Sample views of a scene and write them into an existing folder (see `simtest.sample_views`)."""
    if fps is not None and not FPS[0] <= fps <= FPS[1]:
        raise InputError(f"fps = {fps:g}: must be {FPS[0]:g} to {FPS[1]:g} frames a second")
    rate = (fps or FRAMES_PER_SECOND) if sequence else None
    for pattern in WRITTEN:
        for old in folder.glob(pattern):
            old.unlink()
    with ViewWriter(folder, rate, labels) as writer:
        sampled = sample_views(scene, count, viewpoints, variant, progress, rate, writer.add)
        writer.close()
    # poses in other programs' formats
    views, left_out = sampled.views, list[str]()
    if views:
        times = [view.time_s for view in views if view.time_s is not None]
        names = [view.picture for view in views if view.picture is not None]
        poses = stack([view.world_from_camera for view in views])
        left_out = write_trajectory(Trajectory(names, poses, times or None), scene.camera.model(), folder)[1]
    key = viewpoint_key(scene)
    accepted = [view.to_json(key) for view in views]
    write_json(folder / "views.json", {"tried": sampled.tried, "accepted": accepted, "rejected": sampled.rejected})
    return replace(sampled, poses_left_out=tuple(left_out))


def sample_views(
    scene: Scene,
    count: int,
    viewpoints: Iterable[int | float],
    variant: str | None = None,
    progress: Progress | None = None,
    fps: float | None = None,
    write: Callable[[Session, RenderedView], tuple[str, int]] | None = None,
) -> SampledViews:
    """Try viewpoints one after the other until `count` of them show an isolated highlight, or none is left.

    Noise and lights of the scene matter too, since they decide what is isolated. In a sequence, of `fps` frames a
    second, every view is kept, whatever it shows. `progress` is called with views found, views wanted, and what was
    tried last. `write` writes a view that is kept, at whose scene the session is; it returns the name of its picture
    and the seed of its noise. `InputError` is raised if the surface is no anatomy, it has no such view, or no viewpoint
    has room; of a sequence, if one has none.
    """
    key = viewpoint_key(scene)
    name = key.removeprefix("surface.")
    session: Session | None = None
    kept: list[SampledView] = []
    rejected: Counter[str] = Counter()
    first_error: InputError | None = None
    for viewpoint in viewpoints:
        # Render.
        time_s = scene.time_s + (0.0 if fps is None else len(kept) / fps)
        surface = scene.surface.model_copy(update={name: viewpoint})
        moved = scene.model_copy(update={"surface": surface, "time_s": time_s if scene.deformation else scene.time_s})
        if session is None:
            # Raises where the surface itself is not sound.
            make_surface(surface)
        try:
            session = session or Session(moved, variant)
            view = render_view(session, moved)
        except InputError as error:
            first_error = first_error or InputError(f"{key} = {viewpoint:g}: {error}")
            if fps is not None:
                raise first_error from None
            rejected[NO_ROOM] += 1
        else:
            # Keep, or count the reason.
            if view.isolated or fps is not None:
                pose, time = session.surface.model_from_camera, None if fps is None else time_s
                picture, seed = write(session, view) if write else (None, None)
                kept.append(SampledView(viewpoint, view.isolated, pose, picture, seed, time))
            else:
                rejected[why_none(view.highlights)] += 1
        if progress:
            progress(len(kept), count, f"views kept, tried {key} = {viewpoint:g}")
        if len(kept) == count:
            break
    if first_error is not None and not kept and set(rejected) == {NO_ROOM}:
        raise first_error
    return SampledViews(kept, dict(rejected.most_common()))


def candidates(scene: Scene, count: int) -> list[int | float]:
    """Return viewpoints to try: the first numbers, or shares that cover the camera path evenly at any count."""
    if viewpoint_key(scene) == "surface.viewpoint":
        return list(range(count))
    return [round(0.5 + GOLDEN_SHARE * i, 9) % 1 for i in range(count)]


def along_path(scene: Scene, count: int, first: float, last: float) -> list[int | float]:
    """Return viewpoints evenly spaced along the camera path, in order."""
    if viewpoint_key(scene) == "surface.viewpoint":
        raise InputError("surface.view = auto: views along the path need another; allowed: path, off_axis, wall")
    if not (0 <= first <= 1 and 0 <= last <= 1):
        raise InputError(f"along = {first:g}, {last:g}: must be shares of the path in [0, 1]")
    return [round(first + (last - first) * i / max(count - 1, 1), 9) for i in range(count)]


def viewpoint_key(scene: Scene) -> str:
    """Return the key path that distinguishes an anatomy's views; raise `InputError` for other surfaces."""
    if not isinstance(scene.surface, AnatomySurface):
        raise InputError(f"surface.type = {scene.surface.type}: views are sampled of an anatomy only")
    return "surface.viewpoint" if scene.surface.view == "auto" else "surface.path_share"


class ViewWriter:
    """Writes views into an existing folder as they come: a film where `fps` is given, and a sequence's `labels`."""

    def __init__(self, folder: Path, fps: float | None = None, labels: bool = False) -> None:
        self._folder, self._fps = folder, fps
        self._labels = sequences.SequenceLabels(folder) if labels else None
        self._thumbnails: list[Picture] = []
        self._film: cv2.VideoWriter | None = None

    def __enter__(self) -> "ViewWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove a film that is not finished."""
        if self._film is not None:
            self._film.release()
        (self._folder / PART).unlink(missing_ok=True)

    def add(self, session: Session, view: RenderedView) -> tuple[str, int]:
        """Write the frame of a view, at whose scene the session is; return its file's name and its noise's seed.

        Each has noise of its own, whose seeds count up from the scene's: a film's noise must not stand still.
        """
        sensor = view.scene.sensor
        seed = sensor.seed + len(self._thumbnails)
        frame = view.frame(seed)
        name = f"view_{len(self._thumbnails):04d}.png"
        data = encoded_png(frame, sensor)
        write_atomically(self._folder / name, lambda part: part.write_bytes(data))
        # Film and sheet show sRGB, whatever the sensor's response.
        shown = to_uint8(sensor.response.model().decode(frame).astype(np.float32))
        shown = np.ascontiguousarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR) if shown.ndim == 2 else shown[:, :, ::-1])
        if self._fps is not None:
            if self._film is None:
                # Motion JPEG is the codec that OpenCV writes everywhere.
                file, codec = str(self._folder / PART), cv2.VideoWriter.fourcc(*"MJPG")
                self._film = cv2.VideoWriter(file, codec, self._fps, (shown.shape[1], shown.shape[0]))
                if not self._film.isOpened():
                    raise InputError(f"{self._folder / FILM}: no film can be written here (OpenCV has no Motion JPEG)")
            self._film.write(shown)
        self._thumbnails.append(thumbnail(np.asarray(shown, dtype=np.uint8)))
        if self._labels is not None:
            self._labels.add(session, view)
        return name, seed

    def close(self) -> None:
        """Finish the film, and write the sheet and the labels."""
        if self._film is not None:
            self._film.release()
            os.replace(self._folder / PART, self._folder / FILM)
        if self._thumbnails:
            write_sheet(self._folder / "sheet.png", self._thumbnails)
        if self._labels is not None:
            self._labels.close()
