"""A surface that deforms between two frames: where rays meet it at each moment, and where its material goes."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simtest.rendering import Session
from simtest.runtime.arrays import Array
from simtest.simulation.continuation import Contact, StillSurface, SurfaceInTime, contact
from simtest.simulation.flow import Moved
from simtest.surfaces import RayHits
from simtest.surfaces.deformation import DeformationAt
from simtest.surfaces.deformed import DeformedSurface

BACK, LEAST_BACK = 3.0, 0.01
"""How far before the expected point a carried ray starts: in lengths of the tissue's motion there, and at least as a
share of the distance."""


@dataclass(frozen=True)
class DeformingSurface:
    """The surface between two frames, at a session's scene: that of the second frame, or of the first if reversed.

    Parameters
    ----------
    session : Session
        Its mesh gives the hits from which exact points are solved.
    times_s : tuple of float
        Moments of the first and of the second frame, s.
    fine : bool
        Whether normals are those of the relief, where there is one.
    """

    session: Session
    times_s: tuple[float, float]
    fine: bool = True
    deforms = True

    @property
    def reversed(self) -> "DeformingSurface":
        """The same surface, with time running backwards."""
        return replace(self, times_s=self.times_s[::-1])

    @cached_property
    def _moments(self) -> dict[float, DeformedSurface]:
        return {}

    def _at(self, share: float) -> DeformedSurface:
        """Return the surface at a moment."""
        if share not in self._moments:
            now, scene = self.session.surface, self.session.scene
            assert isinstance(now, DeformedSurface)
            first, second = self.times_s
            moment = DeformationAt(scene.deformation, (1 - share) * first + share * second)
            self._moments[share] = now.at_moment(moment)
        return self._moments[share]

    def meet(self, shares: Array, origins: Array, directions: Array) -> Contact:
        """Return where rays meet the surface, each at its own moment (see `SurfaceInTime.meet`)."""
        count = len(shares)
        whole = Contact(*(np.full((count, *rest), np.nan) for rest in ((3,), (3,), (3,), (3, 3))))
        for share in np.unique(shares):
            own = np.flatnonzero(shares == share)
            surface = self._at(float(share))
            hits = self._hits(surface, origins[own], directions[own])
            for name, values in vars(contact(surface, origins[own], directions[own], hits, self.fine)).items():
                getattr(whole, name)[own] = values
        return whole

    def _hits(self, surface: DeformedSurface, origins: Array, directions: Array) -> RayHits:
        """Return the hits of rays on the mesh at another moment than the session's, from hits on the session's mesh.

        The tissue around the point where the ray meets the session's mesh is carried to the session's moment, and the
        ray with it, as a straight line: it meets the mesh in the triangle that the ray meets at its own moment.
        """
        near = self.session.exact_hits(origins, directions)
        found = np.isfinite(near.distance)
        distance = np.where(found, near.distance, 1.0)
        there, now = surface.deformation, self.session.surface
        assert isinstance(now, DeformedSurface)
        at = origins + distance[:, None] * directions
        X = there.at_rest(at)
        jets = now.deformation.jets(X)
        carried = np.linalg.solve(there.jets(X).jacobian, directions[:, :, None])
        carried = (jets.jacobian @ carried)[:, :, 0]
        speed = np.linalg.norm(carried, axis=1)
        unit: Array = np.asarray(carried / speed[:, None], dtype=float)
        back = BACK * np.linalg.norm(jets.value - at, axis=1) + LEAST_BACK * distance
        hits = self.session.exact_hits(jets.value - back[:, None] * unit, unit)
        return RayHits(np.where(found, distance + (hits.distance - back) / speed, np.inf), hits.face, hits.barycentric)


class SurfaceOverTime:
    """Gives the surface between each frame of a sequence and the next, whether it deforms or not.

    Attributes
    ----------
    time_s : float or None
        Moment of the last frame; None before the first.
    """

    def __init__(self) -> None:
        self.time_s: float | None = None

    def between(self, session: Session, fine: bool) -> SurfaceInTime:
        """Return the surface between the last frame and a session's (see `tracks.SurfaceBetween`)."""
        if self.time_s is None or not isinstance(session.surface, DeformedSurface):
            return StillSurface(session, fine)
        return DeformingSurface(session, (self.time_s, session.scene.time_s), fine)


def moved_between(session: Session, first_s: float, second_s: float) -> Moved | None:
    """Return what maps points of the world at one moment to where the same tissue is at another; None: they stay."""
    if not isinstance(session.surface, DeformedSurface):
        return None
    parts = session.scene.deformation
    first, second = DeformationAt(parts, first_s), DeformationAt(parts, second_s)
    return lambda points: second.moved(first.at_rest(points))
