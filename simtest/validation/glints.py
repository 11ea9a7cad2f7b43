"""What a row of results holds on a surface with relief: visible highlights, sizes, and clouds of glints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from simtest.conventions import HIGHLIGHT_CONTRAST_SIGMA
from simtest.geometry.vectors import angle_deg
from simtest.rendering import HighlightPoint, Session
from simtest.runtime.arrays import Array
from simtest.simulation.frame import RenderedView
from simtest.simulation.highlights import CloudRegions, TrueHighlight, VisibleHighlight
from simtest.validation.columns import Row
from simtest.validation.predicted import centroid_law_deg, glint_count_law

MISSED_PX = 3.0
"""A missed glint belongs to the visible highlight whose peak is so near."""

WHOLE_SLOPES = 3.0
"""A cloud is wholly in view if the base's misfit at the edge of its region is so many slopes: by Rayleigh's law 1.1 %
of its glints are outside."""


@dataclass(frozen=True)
class RoughTruth:
    """What stands beside the true highlights of a frame on a relief; all empty on a smooth surface.

    Parameters
    ----------
    visible : sequence of VisibleHighlight
        On a smooth surface a visible highlight is a true highlight (theory.md 7.1b).
    seen : mapping
        Index of the visible highlight by index of the detection.
    alone_px : mapping
        Radius of the visible highlight that is whole and holds one glint alone, px, by index of the truth.
    clouds : mapping
        Columns of those wholly in view, by number (`whole_clouds`).
    is_rough : bool
        Whether the surface has a relief.
    """

    visible: Sequence[VisibleHighlight] = ()
    seen: Mapping[int, int] = field(default_factory=dict)
    alone_px: Mapping[int, float] = field(default_factory=dict)
    clouds: Mapping[int, Row] = field(default_factory=dict)
    is_rough: bool = False

    @cached_property
    def _peaks_px(self) -> Array:
        """Peaks of the visible highlights, px, shape (V, 2): thousands of missed glints are held against them."""
        return np.array([spot.peak_px for spot in self.visible], dtype=float).reshape(-1, 2)

    @cached_property
    def _shown(self) -> int:
        """Visible highlights above the noise, of the surface: what shines on an instrument is no missing answer."""
        return len(shown([spot for spot in self.visible if spot.instrument is None]))

    def columns(self, specularity: int | None, true_id: int | None, truth: TrueHighlight | None) -> Row:
        """Return the columns of a detection's row, or of that of a truth which no detection found."""
        number = None if specularity is None else self.seen.get(specularity)
        if number is None and specularity is None and truth is not None:
            # The spot in which the missed glint shines.
            near = np.hypot(*(self._peaks_px - truth.bp_px).T)
            number = int(np.argmin(near)) if len(near) and near.min() < MISSED_PX else None
        snr = None if number is None else self.visible[number].peak_snr
        row: Row = {"visible_id": number, "visible_snr": snr if snr is not None and np.isfinite(snr) else None}
        if self.is_rough:
            row["frame_visible"] = self._shown
        owner = truth if truth is not None else None if number is None else self.visible[number]
        cloud = None if owner is None else owner.cloud
        row["cloud"] = cloud
        if truth is not None and self.is_rough:
            law = truth.radius_px if np.isfinite(truth.radius_px) else None
            alone = None if true_id is None else self.alone_px.get(true_id)
            row |= {"pool": truth.pool, "radius_px": alone, "radius_law_px": law}
        return row if cloud is None else row | self.clouds.get(cloud, {})


def shown(visible: Sequence[VisibleHighlight]) -> list[VisibleHighlight]:
    """Return the visible highlights that stand above the noise as isolated ones do (theory.md section 6)."""
    return [spot for spot in visible if spot.peak_snr >= HIGHLIGHT_CONTRAST_SIGMA]


def rough_truth(session: Session, view: RenderedView, counted: Sequence[int], seen: Mapping[int, int]) -> RoughTruth:
    """Gather what stands beside the true highlights of a view on a relief, at whose scene the session is.

    `counted` are the indices in `view.highlights` of the truths; for `seen` see `RoughTruth`.
    """
    visible = view.visible_highlights
    alone = {spot.glints[0]: spot.radius_px for spot in visible if spot.whole and len(spot.glints) == 1}
    alone_px = {truth: alone[i] for truth, i in enumerate(counted) if i in alone}
    return RoughTruth(visible, seen, alone_px, whole_clouds(session, view), is_rough=True)


def whole_clouds(session: Session, view: RenderedView) -> dict[int, Row]:
    """Return the columns of the clouds of a view that are wholly in view, by number (`WHOLE_SLOPES`).

    A cloud is the glints of one light around one highlight point of the base (theory.md 7.1 to 7.5). With the light at
    the camera the glints' fine normals are the reversed sightlines (7.5).
    """
    relief = view.scene.surface.relief
    assert relief is not None
    least = WHOLE_SLOPES * np.radians(relief.slope_deg)
    edges = CloudRegions.of(session, view.clouds).edges()
    return {n: _cloud_columns(view, n, centre) for n, centre in enumerate(view.clouds) if edges[n] >= least}


def _cloud_columns(view: RenderedView, number: int, centre: HighlightPoint) -> Row:
    glints = [glint for glint in view.highlights if glint.cloud == number]
    row: Row = {
        "cloud_glints": len(glints),
        "cloud_glints_law": glint_count_law(view.scene, centre),
        "cloud_visible": sum(spot.cloud == number for spot in shown(view.visible_highlights)),
        "cloud_kd_min": centre.kd_min,
        "cloud_kd_max": centre.kd_max,
    }
    if not glints:
        return row
    mean = np.mean([glint.normal for glint in glints], axis=0)
    axes = np.stack([centre.direction_min, np.cross(centre.normal, centre.direction_min)])
    at = (np.array([glint.position for glint in glints]) - centre.position) @ axes.T
    covariance = at.T @ at / len(glints)
    return row | {
        "cloud_error_deg": float(angle_deg(mean / np.linalg.norm(mean), centre.normal)),
        "cloud_error_law_deg": centroid_law_deg(view.scene, centre, len(glints)),
        "cloud_cov_11": float(covariance[0, 0]),
        "cloud_cov_12": float(covariance[0, 1]),
        "cloud_cov_22": float(covariance[1, 1]),
    }
