"""The base of a surface with relief, as the search for highlight points sees it."""

from typing import TYPE_CHECKING

from simtest.rendering import exact_points as exact
from simtest.runtime.arrays import Array
from simtest.surfaces import SurfacePoints

if TYPE_CHECKING:
    from simtest.rendering.session import Session


class BaseCaster:
    """A session that casts onto the base, as the search for highlight points does."""

    def __init__(self, session: "Session") -> None:
        self._session = session
        self.scene, self.camera = session.scene, session.camera
        self.lit = session.lit

    def cast_rendered(self, points_px: Array) -> tuple[Array, Array]:
        """Return what `Session.cast_rendered` does, with normals of the base."""
        return self._session._cast_rendered(points_px, None)

    def cast(self, points_px: Array) -> tuple[SurfacePoints, Array, Array]:
        """Return what `Session.cast` does, with normals and curvatures of the base."""
        session = self._session
        origins, directions = session.sightlines.in_model(points_px)
        hits, shading, geometric = session._hits(origins, directions)
        return exact.solve(session.surface, origins, directions, hits, fine=False), shading, geometric
