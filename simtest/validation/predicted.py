"""Predictions of the laws of theory.md sections 4 and 7 for an estimate at a true highlight."""

from collections.abc import Collection
from functools import lru_cache

import numpy as np

from simtest.estimators import Estimate
from simtest.estimators.protocol import Law
from simtest.rendering import HighlightPoint
from simtest.runtime.arrays import Array
from simtest.spec.lights import CosineProfile, is_at_camera
from simtest.spec.reflectance import PhongReflectance
from simtest.spec.scene import Scene
from simtest.spec.surfaces import Relief
from simtest.validation import laws

EQUAL_KD = 1e-3
"""Principal curvatures times distance that differ by less are those of a plane or a sphere."""


def law_deg(scene: Scene, declared: Collection[Law], estimate: Estimate, highlight: HighlightPoint) -> float | None:
    """Predict the error of an estimate, deg; None where none of the laws that its estimator declares applies.

    With a light at the camera: circle pose on a curved surface without falloff; the shift by unknown vignetting and
    emission for the others. With an offset light: half the angle between light and camera for the reversed sightline;
    for the bisector with a given distance, the effect of the distance's error.
    """
    # The lobe of a source of finite size is another one: no law.
    if scene.rig.lights[highlight.light].source is not None:
        return None
    # Offset light and unknown falloff together: no law.
    light = scene.rig.true_mm()[highlight.light]
    offset, power = not is_at_camera(light), unknown_falloff(scene, highlight.light)
    if power is None or (offset and power > 0):
        return None
    if "sightline" in declared or "bisector" in declared:
        if offset:
            return _offset_law_deg(scene, declared, highlight, light)
        return _vignetting_law_deg(scene, estimate, highlight, power) if power > 0 else None
    if "circle_pose" not in declared or offset or power > 0 or len(estimate.isophotes) != 1:
        return None
    a, b = laws.isophote_half_axes(
        estimate.isophotes[0].isovalue, lobe_curvature(scene), highlight.kd_min, highlight.kd_max
    )
    error = float(np.degrees(laws.circle_pose_error(a, b)))
    return error if np.isfinite(error) else None


def unknown_falloff(scene: Scene, light: int) -> float | None:
    """Return k of the falloff cos^k about the optical axis that reconstruction is not told; None for another form."""
    sensor, emitter = scene.sensor, scene.rig.lights[light]
    parts = [] if sensor.vignetting_known else [sensor.vignetting]
    if scene.rig.known_emission() is None and not emitter.is_isotropic:
        if (profile := emitter.profile_of_view) is None:
            return None
        parts.append(profile)
    powers = [part.power if isinstance(part, CosineProfile) else None for part in parts]
    return None if None in powers else float(sum(power for power in powers if power))


def _vignetting_law_deg(scene: Scene, estimate: Estimate, highlight: HighlightPoint, power: float) -> float | None:
    """Predict the shift by unknown falloff cos^power, deg; None where the curvatures differ."""
    if abs(highlight.kd_max - highlight.kd_min) > EQUAL_KD:
        return None
    off_axis = np.arccos(highlight.position[2] / np.linalg.norm(highlight.position))
    isovalues = [isophote.isovalue for isophote in estimate.isophotes] or [1.0]
    shifts = laws.vignetting_shift(off_axis, power, lobe_curvature(scene), highlight.kd_min, isovalues)
    return float(np.degrees(shifts.mean())) if np.isfinite(shifts).all() else None


def lobe_curvature(scene: Scene) -> float:
    """Return c = -(log f)''(0) of a scene's lobe; that of a very narrow lobe where it has no closed form."""
    return scene.reflectance.lobe_curvature or 1e6


def _offset_law_deg(
    scene: Scene, declared: Collection[Law], highlight: HighlightPoint, light: Array
) -> float | None:  # fmt: skip
    """Predict the error of the reversed sightline or of the bisector with a light beside the camera, deg."""
    priors = scene.calibration(highlight.distance).priors
    if "sightline" in declared or not priors.lights_mm:
        return float(np.degrees(laws.bisector_angle(highlight.position, light)))
    # With several lights the estimate may assume another light, and another distance, than the highlight's.
    if priors.distance_mm is None or len(scene.rig.lights) > 1:
        return None
    share = priors.distance_mm.mean / highlight.distance - 1
    return float(np.degrees(laws.bisector_residual(highlight.position, light, share)))


def axis_ratio_seen(
    scene: Scene, declared: Collection[Law], estimate: Estimate, highlight: HighlightPoint, smoothing_px: float
) -> float | None:
    """Predict the axis ratio of an estimator that takes the isophotes as they are; None for others.

    For a Phong lobe without a base under a light at the camera, mean of the estimate's isovalues.
    """
    reflectance = scene.reflectance
    isovalues = tuple(float(isophote.isovalue) for isophote in estimate.isophotes)
    if not isinstance(reflectance, PhongReflectance) or reflectance.normalised or reflectance.diffuse != 0:
        return None
    light = scene.rig.lights[highlight.light]
    at_camera = is_at_camera(scene.rig.true_mm()[highlight.light]) and light.source is None
    if not (isovalues and at_camera and "axis_ratio_seen" in declared):
        return None
    curvatures, pixel = (highlight.kd_min, highlight.kd_max), _pixel_angle(scene, highlight)
    return _mean_ratio_seen(isovalues, reflectance.exponent, curvatures, smoothing_px, pixel)


@lru_cache(maxsize=1024)
def _mean_ratio_seen(
    isovalues: tuple[float, ...], exponent: float, kd: tuple[float, float], smoothing_px: float, pixel: float
) -> float | None:
    """Compute the mean of `laws.axis_ratio_seen` over isovalues; the realisations of one view ask for the same."""
    ratios = laws.axis_ratio_seen(isovalues, exponent, *kd, smoothing_px, pixel)
    return float(ratios.mean()) if np.isfinite(ratios).all() else None


def _pixel_angle(scene: Scene, highlight: HighlightPoint) -> float:
    """Compute the angle of a pixel at a BP, rad: the root of its solid angle."""
    steps = scene.camera.model().step_of_pixels(highlight.bp_px)
    return float(np.sqrt(np.linalg.norm(np.cross(*steps))))


def look_law_deg(
    scene: Scene, declared: Collection[Law], estimate: Estimate, highlight: HighlightPoint
) -> float | None:  # fmt: skip
    """Predict the error where an estimate looks: abs((I + dS) w) of its own miss w, deg (theory.md section 4).

    For estimators that take the reversed sightline for the normal, as the bisector is under a light at the camera; None
    for others, and elsewhere.
    """
    at_camera = is_at_camera(scene.rig.true_mm()[highlight.light])
    if not at_camera or not {"sightline", "bisector"} & set(declared) or not np.isfinite(estimate.look_px).all():
        return None
    look = scene.camera.model().unproject(estimate.look_px)
    sightline = highlight.position / np.linalg.norm(highlight.position)
    # w: the miss across the true sightline, per unit distance along it.
    across = look / (look @ sightline) - sightline
    # The miss along the principal directions.
    first, second = highlight.direction_min, np.cross(highlight.normal, highlight.direction_min)
    miss = np.array([across @ first, across @ second])
    return float(np.degrees(laws.look_error(miss, highlight.kd_min, highlight.kd_max)))


def base_law_deg(scene: Scene) -> float | None:
    """Predict the mean error against the base's normal of the glints of a whole cloud, deg (theory.md 7.4).

    For isotropic gaussian relief without pools; None for other surfaces.
    """
    relief = _lawful_relief(scene)
    return None if relief is None else float(np.degrees(laws.relief_error(np.radians(relief.slope_deg))))


def glint_count_law(scene: Scene, centre: HighlightPoint) -> float | None:
    """Predict the number of glints of the cloud around a highlight point of the base (theory.md 7.2).

    For isotropic gaussian relief without pools under a light at the camera; None for others.
    """
    relief = _lawful_relief(scene)
    if relief is None or not is_at_camera(scene.rig.true_mm()[centre.light]):
        return None
    # Bands are independent: their moments add.
    squared = np.array([np.radians(band.slope_deg) ** 2 for band in relief.bands])
    waves = np.array([band.wavelength_mm for band in relief.bands])
    wave = np.sqrt(squared.sum() / np.sum(squared / waves**2))
    gains = 1 + centre.kd_min, 1 + centre.kd_max
    return laws.glint_count(float(np.sqrt(squared.sum())), float(wave), centre.distance, gains)


def centroid_law_deg(scene: Scene, centre: HighlightPoint, glints: int) -> float | None:
    """Predict the mean error of the mean normal of so many glints, if they were independent, deg (theory.md 7.5).

    Where `glint_count_law` holds; None elsewhere.
    """
    relief = _lawful_relief(scene)
    if relief is None or not is_at_camera(scene.rig.true_mm()[centre.light]):
        return None
    gains = 1 + centre.kd_min, 1 + centre.kd_max
    return float(np.degrees(laws.independent_centroid_error(np.radians(relief.slope_deg), glints, gains)))


def _lawful_relief(scene: Scene) -> Relief | None:
    """Return a scene's relief where it is isotropic, gaussian and without pools, as the laws of glints take it."""
    relief = scene.surface.relief
    if relief is None or scene.film_level is not None:
        return None
    if any(band.kind != "gaussian" or band.anisotropy != 1 for band in relief.bands):
        return None
    return relief
