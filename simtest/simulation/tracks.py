"""True highlights with identities over the frames of a sequence.

The highlight points of a smooth surface move continuously while camera and lights do. Each frame's points are found
anew; those of one frame are followed to the next (`continuation`), and where one arrives at a point that was found
there, both are the same highlight. Points that are left over in the second frame are followed back: where they come
from says why they are new.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from simtest.geometry import Camera
from simtest.rendering import HighlightPoint, Session
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import Json
from simtest.simulation import continuation
from simtest.simulation.continuation import LOST, MERGED, REACHED, Continued, Motion, StillSurface, SurfaceInTime

SAME_PX = 0.1
"""A followed point is the one found at the next frame where it arrives within this of it."""

BORDER, UNLISTED, ENDS = "frame border", "not found", "sequence"
BEGINS = {MERGED: "split"}
"""Names of what is called otherwise at a birth: two highlights that merge are, the other way round, one pair born."""

SurfaceBetween = Callable[[Session, bool], SurfaceInTime]
"""Returns the surface between the last frame and a session's: that of the relief (True), or its base (False)."""


@dataclass
class Track:
    """One highlight over consecutive frames.

    Parameters
    ----------
    light : int
        Index of the light.
    first_frame : int
        Frame in which it is born.
    birth : str
        Why: "sequence" (it is there in the first frame), "frame border" (it enters the view), "split" (a pair is born
        at a fold of the misfit), "hidden" (another part of the surface stood before it), "off the surface", "not
        found" (it lies in the view of the frame before too, but the search did not list it there), or "not followed"
        (its motion bends too much for the shortest step, or leads to another highlight's point).
    death : str
        Why it has no point in the frame after its last: by the same names, "merged" instead of "split".
    entries : list of int
        Its index in each frame's list of highlights.
    points_px, positions : list of ndarray
        BP, px, and point of the surface, world frame, mm, in each frame.
    """

    light: int
    first_frame: int
    birth: str
    death: str = ENDS
    entries: list[int] = field(default_factory=list)
    points_px: list[Array] = field(default_factory=list)
    positions: list[Array] = field(default_factory=list)

    def to_json(self) -> dict[str, Json]:
        """Return the track's entry of tracks.json."""
        return {
            "light": self.light,
            "first_frame": self.first_frame,
            "birth": self.birth,
            "death": self.death,
            "entries": list(self.entries),
            "bp_px": [point.tolist() for point in self.points_px],
            "position_world_mm": [point.tolist() for point in self.positions],
        }


@dataclass(frozen=True)
class _Seen:
    """A frame's highlight points: camera, pose, lights and positions in the world, mm."""

    camera: Camera
    world_from_camera: Array
    lights: Array
    light: IntArray
    points_px: Array
    positions: Array

    def project(self, positions: Array) -> Array:
        """Return the pixels of points of the world, shape (N, 2)."""
        R, centre = self.world_from_camera[:3, :3], self.world_from_camera[:3, 3]
        return self.camera.project((positions - centre) @ R)


class Tracks:
    """Follows the highlights of the fine surface or of its base over frames that are added in order.

    Parameters
    ----------
    fine : bool
        Whether the highlights are those of the fine surface.
    surface : callable, optional
        See `SurfaceBetween`; default a surface that does not deform.

    Attributes
    ----------
    tracks : list of Track
        In the order of birth.
    frames : int
        Frames added.
    """

    def __init__(self, fine: bool = True, surface: SurfaceBetween = StillSurface) -> None:
        self.fine, self.frames = fine, 0
        self.tracks: list[Track] = []
        self._surface = surface
        self._last: _Seen | None = None
        self._of_entry: dict[int, Track] = {}

    def add(self, session: Session, highlights: Sequence[HighlightPoint]) -> list[int]:
        """Add the next frame.

        Parameters
        ----------
        session : Session
            At the frame's scene.
        highlights : sequence of HighlightPoint
            Of the frame: all of the fine surface, or all of the base.

        Returns
        -------
        list of int
            Identity of each highlight: index of its track.
        """
        seen, last = _seen(session, highlights), self._last
        partner: dict[int, int] = {}
        births = [ENDS] * len(highlights)
        if last is not None:
            partner, births, deaths = self._linked(session, last, seen)
            for entry, track in self._of_entry.items():
                track.death = deaths[entry]
        of_entry = {}
        for entry in range(len(highlights)):
            if entry in partner:
                track = self._of_entry[partner[entry]]
                track.death = ENDS
            else:
                track = Track(int(seen.light[entry]), self.frames, births[entry])
                self.tracks.append(track)
            track.entries.append(entry)
            track.points_px.append(seen.points_px[entry])
            track.positions.append(seen.positions[entry])
            of_entry[entry] = track
        self._of_entry, self._last = of_entry, seen
        self.frames += 1
        numbers = {id(track): number for number, track in enumerate(self.tracks)}
        return [numbers[id(of_entry[entry])] for entry in range(len(highlights))]

    def _linked(self, session: Session, last: _Seen, seen: _Seen) -> tuple[dict[int, int], list[str], list[str]]:
        """Return the last frame's entry that each linked one of this frame continues; why others are born and die."""
        surface = self._surface(session, self.fine)
        motion = Motion((last.world_from_camera[:3, 3], seen.world_from_camera[:3, 3]), (last.lights, seen.lights))
        forward = continuation.follow(surface, motion, last.positions, last.light)
        partner, deaths = _arrivals(forward, last.light, seen)
        # Back from what is left over: where a fold is near, one way may succeed where the other does not.
        rest = np.array([i for i in range(len(seen.light)) if i not in partner], dtype=np.int64)
        backward = continuation.follow(surface.reversed, motion.reversed, seen.positions[rest], seen.light[rest])
        origins, why = _arrivals(backward, seen.light[rest], last)
        births = [ENDS] * len(seen.light)
        taken = set(partner.values())
        for entry, reason in zip(rest, why, strict=True):
            births[entry] = BEGINS.get(reason, reason)
        for origin, of_rest in origins.items():
            if origin not in taken:
                partner[int(rest[of_rest])] = origin
        births = [birth or UNLISTED for birth in births]
        return partner, births, [death or UNLISTED for death in deaths]

    def to_json(self) -> list[Json]:
        """Return the tracks as JSON."""
        return [track.to_json() for track in self.tracks]


def _seen(session: Session, highlights: Sequence[HighlightPoint]) -> _Seen:
    lights = session.to_model(session.scene.rig.true_mm())
    positions = np.array([highlight.position for highlight in highlights]).reshape(-1, 3)
    return _Seen(
        camera=session.camera,
        world_from_camera=session.surface.model_from_camera,
        lights=lights,
        light=np.array([highlight.light for highlight in highlights], dtype=np.int64),
        points_px=np.array([highlight.bp_px for highlight in highlights]).reshape(-1, 2),
        positions=session.to_model(positions),
    )


def _arrivals(followed: Continued, lights: IntArray, there: _Seen) -> tuple[dict[int, int], list[str]]:
    """Return which followed point arrives at each point of a frame, and why the others do not (empty: they do)."""
    pixels = there.project(followed.position)
    partner: dict[int, int] = {}
    nearest: dict[int, float] = {}
    reasons = list(followed.end)
    for i, (pixel, light, end) in enumerate(zip(pixels, lights, followed.end, strict=True)):
        if end != REACHED:
            continue
        gaps = np.where(there.light == light, np.hypot(*(there.points_px - pixel).T), np.inf)
        best = int(gaps.argmin()) if len(gaps) else -1
        if best >= 0 and gaps[best] < SAME_PX:
            reasons[i] = REACHED
            if gaps[best] < nearest.get(best, np.inf):
                # Two points cannot be one; the nearer one is it.
                if best in partner:
                    reasons[partner[best]] = LOST
                partner[best], nearest[best] = i, float(gaps[best])
            else:
                reasons[i] = LOST
        else:
            reasons[i] = UNLISTED if there.camera.contains(pixel) else BORDER
    return partner, reasons
