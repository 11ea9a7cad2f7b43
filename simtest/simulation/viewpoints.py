"""Picks viewpoints of an anatomy that show isolated highlights, and counts why others are left out.

A viewpoint is a number, where ``surface.view`` is auto, or else a share of the camera path.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from simtest.errors import InputError
from simtest.rendering import Session
from simtest.runtime.arrays import Array
from simtest.runtime.files import Json
from simtest.simulation.frame import RenderedView, render_view
from simtest.spec import AnatomySurface, Scene
from simtest.surfaces import make_surface

NO_HIGHLIGHT, NO_ROOM = "no highlight in view", "no room for the camera, a light or an instrument"

GOLDEN_SHARE = 0.6180339887498949
"""Multiples of it, modulo 1, cover [0, 1) evenly at any number of them."""

Progress = Callable[[int, int, str], None]
"""Called with views found, views wanted, and what was tried last."""


class WrittenView(NamedTuple):
    """The picture of a view: the file's name, and the seed of its noise."""

    picture: str
    seed: int


@dataclass(frozen=True)
class SampledView:
    """A view that was kept.

    Parameters
    ----------
    viewpoint : int or float
        Number, or share of the camera path.
    isolated_highlights : int
        How many isolated highlights it shows.
    model_from_camera : ndarray, shape (4, 4)
        Pose, mm.
    written : WrittenView, optional
        Its picture.
    time_s : float, optional
        When it is seen, s; None where the views are no sequence.
    """

    viewpoint: int | float
    isolated_highlights: int
    model_from_camera: Array
    written: WrittenView | None
    time_s: float | None = None

    @property
    def world_from_camera(self) -> Array:
        """Pose, shape (4, 4), mm: the world is the surface's own frame."""
        return self.model_from_camera

    def to_json(self, key: str) -> dict[str, Json]:
        """Return the entry of views.json; `key` is the viewpoint's key path."""
        entry: dict[str, Json] = {
            key: self.viewpoint,
            "isolated_highlights": self.isolated_highlights,
            "world_from_camera": self.model_from_camera.tolist(),
            # The older name of the same pose.
            "model_from_camera": self.model_from_camera.tolist(),
        }
        if self.time_s is not None:
            entry["time_s"] = self.time_s
        if self.written is not None:
            entry |= {"picture": self.written.picture, "sensor.seed": self.written.seed}
        return entry


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

    def to_json(self, key: str) -> dict[str, Json]:
        """Return the content of views.json; `key` is the viewpoints' key path."""
        return {"tried": self.tried, "accepted": [view.to_json(key) for view in self.views], "rejected": self.rejected}


def sample_views(
    scene: Scene,
    count: int,
    viewpoints: Iterable[int | float],
    variant: str | None = None,
    progress: Progress | None = None,
    write: Callable[[RenderedView], WrittenView] | None = None,
    fps: float | None = None,
    label: Callable[[Session, RenderedView], None] | None = None,
) -> SampledViews:
    """Try viewpoints one after the other until `count` of them show an isolated highlight, or none is left.

    Parameters
    ----------
    scene : Scene
        Of an anatomy; its noise and lights matter too, since they decide what is isolated.
    count : int
        Views wanted, >= 1.
    viewpoints : iterable
        Numbers, or shares of the camera path where ``surface.view`` is not auto.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        See `Progress`.
    write : callable, optional
        Writes the picture of a view that is kept.
    fps : float, optional
        Frames a second of a sequence: every view is kept, whatever it shows.
    label : callable, optional
        Called with the session at the scene of a view that is kept, and the view: it labels the sequence.

    Raises
    ------
    InputError
        If the surface is no anatomy, it has no such view, or no viewpoint has room; of a sequence, if one has none.
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
                kept.append(SampledView(viewpoint, view.isolated, pose, write(view) if write else None, time))
                if label is not None:
                    label(session, view)
            else:
                rejected[_reason(view)] += 1
        if progress:
            progress(len(kept), count, f"{key} = {viewpoint:g}")
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


def _reason(view: RenderedView) -> str:
    """Return why a view has no isolated highlight: the reason of the highlight that stands out most."""
    if not view.highlights:
        return NO_HIGHLIGHT
    return max(view.highlights, key=lambda highlight: highlight.peak_snr).why_not
