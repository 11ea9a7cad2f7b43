"""Picks the views of an anatomy that show isolated highlights, and counts why the others are left out."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from simtest.errors import InputError
from simtest.rendering import Session
from simtest.simulation.rendered_view import View, view
from simtest.spec import AnatomySurface, Scene

NO_HIGHLIGHT = "no highlight in view"

Tell = Callable[[int, int, str], None]
"""Called with views found, views wanted, and what was tried last."""

Keep = Callable[[View], dict[str, Any]]
"""Called with each view that is kept; what it gives goes into views.json beside the view's place."""


@dataclass(frozen=True)
class SampledViews:
    """Views that show isolated highlights.

    Parameters
    ----------
    places : list
        Viewpoint numbers, or shares of the camera path, in the order tried.
    highlights : list of int
        How many isolated highlights each shows.
    rejected : dict
        Number of places left out by reason: `NO_HIGHLIGHT`, or why the last condition of theory.md section 6 that a
        highlight of the view came to was not met.
    more : list of dict
        What else is known of each, such as the pose.
    """

    places: list[int | float]
    highlights: list[int]
    rejected: dict[str, int]
    more: list[dict[str, Any]]

    @property
    def tried(self) -> int:
        """How many places were tried."""
        return len(self.places) + sum(self.rejected.values())

    def as_dict(self, key: str) -> dict[str, Any]:
        """Give the content of views.json; `key` is the key path that the places are values of."""
        accepted = [
            {key: place, "isolated_highlights": number, **more}
            for place, number, more in zip(self.places, self.highlights, self.more, strict=True)
        ]
        return {"tried": self.tried, "accepted": accepted, "rejected": self.rejected}


def sample_views(
    scene: Scene,
    count: int,
    places: Iterable[int | float],
    variant: str | None = None,
    tell: Tell | None = None,
    keep: Keep | None = None,
    every: bool = False,
) -> SampledViews:
    """Try places one after the other until enough of them show an isolated highlight.

    Parameters
    ----------
    scene : Scene
        Of an anatomy; noise and light count, since they decide what is isolated.
    count : int
        Views wanted, >= 1.
    places : iterable
        Viewpoint numbers, or shares of the camera path where ``surface.view`` is not auto.
    variant : str, optional
        Mitsuba variant.
    tell : callable, optional
        See `Tell`.
    keep : callable, optional
        See `Keep`.
    every : bool
        Leave no place out, whatever it shows: a sequence.

    Returns
    -------
    SampledViews
        With fewer than `count` views where the places ran out.

    Raises
    ------
    InputError
        If the surface is no anatomy, or no view of it can be had.
    """
    key = place_key(scene)
    name = key.removeprefix("surface.")
    session: Session | None = None
    found: list[int | float] = []
    numbers: list[int] = []
    more: list[dict[str, Any]] = []
    rejected: Counter[str] = Counter()
    for place in places:
        surface = scene.surface.model_copy(update={name: place})
        at_place = scene.model_copy(update={"surface": surface})
        session = session or Session(at_place, variant)
        seen = view(session, at_place)
        isolated = sum(truth.isolated for truth in seen.truths)
        if isolated or every:
            found.append(place)
            numbers.append(isolated)
            pose = {"model_from_camera": session.surface.model_from_camera.tolist()}
            more.append({**pose, **(keep(seen) if keep else {})})
        else:
            rejected[_why(seen)] += 1
        if tell:
            tell(len(found), count, f"{key} = {place:g}")
        if len(found) == count:
            break
    return SampledViews(found, numbers, dict(rejected.most_common()), more)


def candidates(scene: Scene, count: int) -> list[int | float]:
    """Give the places to try: viewpoint numbers, or shares of the camera path that cover it evenly at any length."""
    if place_key(scene) == "surface.viewpoint":
        return list(range(count))
    return [round(0.5 + 0.6180339887498949 * i, 9) % 1 for i in range(count)]


def along_path(scene: Scene, count: int, first: float, last: float) -> list[int | float]:
    """Give places evenly spaced along the camera path, in order.

    Raises
    ------
    InputError
        If the scene's views are not on the path, or a share is out of range.
    """
    if place_key(scene) == "surface.viewpoint":
        raise InputError("surface.view = auto: views along the path need another; allowed: path, off_axis, wall")
    if not (0 <= first <= 1 and 0 <= last <= 1):
        raise InputError(f"along = {first:g}, {last:g}: must be shares of the path in [0, 1]")
    return [round(first + (last - first) * i / max(count - 1, 1), 9) for i in range(count)]


def place_key(scene: Scene) -> str:
    """Give the key path that tells an anatomy's views apart."""
    if not isinstance(scene.surface, AnatomySurface):
        raise InputError(f"surface.type = {scene.surface.type}: views are sampled of an anatomy only")
    return "surface.viewpoint" if scene.surface.view == "auto" else "surface.path_share"


def _why(seen: View) -> str:
    """Give why a view has no isolated highlight: of its highlights', the reason of the one that stands out most."""
    if not seen.truths:
        return NO_HIGHLIGHT
    return max(seen.truths, key=lambda truth: truth.peak_snr).why_not
