"""A rendered scene with its true highlights, exposed and ready for the camera's noise."""

import warnings
from dataclasses import dataclass

import numpy as np

from simtest.calibration import Calibration, NoiseModel
from simtest.rendering import HighlightPoint, Radiance, Session
from simtest.runtime.arrays import Array, Image, Mask
from simtest.runtime.seeds import from_integer
from simtest.simulation.camera_chain import capture, collect
from simtest.simulation.true_highlights import TrueHighlight, judge
from simtest.spec import Scene

LEAST_SHARE = 1e-12
"""A percentile of the radiance that is no more than this share of its maximum is darkness, and sets no exposure."""


@dataclass(frozen=True)
class RenderedView:
    """A rendered scene with its true highlights: everything that its noise realisations share.

    Parameters
    ----------
    scene : Scene
        What was rendered.
    radiance : Radiance
        Noise-free, before the lens.
    light : ndarray of float32, shape (H, W) or (H, W, 3)
        Noise-free radiance behind the lens: what reaches the sensor.
    highlights : list of TrueHighlight
        All of them, including those that do not count.
    full_scale : float
        Radiance behind the lens that becomes 1 (`Exposure`); 0 where no light reaches the sensor.
    calibration : Calibration
        What reconstruction is told.
    """

    scene: Scene
    radiance: Radiance
    light: Image
    highlights: list[TrueHighlight]
    full_scale: float
    calibration: Calibration

    def frame(self, seed: int) -> Image:
        """Return the sensor's frame with the noise of a seed."""
        return capture(self.light, self.full_scale, self.scene.sensor, from_integer(seed))


def render_view(session: Session, scene: Scene, radiance: Radiance | None = None) -> RenderedView:
    """Move a session to a scene, render it, unless its radiance is given, and judge its highlights."""
    session.update(scene)
    if radiance is None:
        radiance = session.radiance()
    # Lens.
    light = collect(radiance.total, scene.sensor, session.camera)
    mean = light if light.ndim == 2 else light.mean(axis=2, dtype=np.float32)
    # Truth and exposure. Noise is independent in each channel; estimators see the channels' mean.
    points, seen = session.highlights(radiance), session.camera.seen
    full_scale = _full_scale(scene, mean, points, seen)
    highlights = judge(points, mean, scene.sensor.noise_model(), full_scale, radiance.channels, seen)
    # What reconstruction is told may include the distance of the brightest highlight.
    brightest = max((h for h in highlights if h.lit), key=lambda h: h.radiance, default=None)
    calibration = scene.calibration(None if brightest is None else brightest.distance)
    return RenderedView(scene, radiance, light, highlights, full_scale, calibration)


def _full_scale(scene: Scene, light: Image, points: list[HighlightPoint], seen: Mask | None) -> float:
    """Return the radiance that becomes 1; 0, with a warning, where there is no light at all."""
    exposure, peak = scene.sensor.exposure, float(light.max())
    if peak <= 0:
        warnings.warn(f"scene {scene.name}: no light reaches the sensor; its frame is dark", stacklevel=3)
        return 0.0
    # Fixed by the scene, or by a percentile of the frame, or by its brightest isolated highlight.
    if exposure.full_scale is not None:
        radiance = exposure.full_scale
    elif exposure.percentile is not None:
        radiance = float(np.percentile(light if seen is None else light[seen], exposure.percentile))
        if radiance <= LEAST_SHARE * peak:
            warnings.warn(
                f"scene {scene.name}: sensor.exposure.percentile = {exposure.percentile:g}: that of the radiance is "
                f"{radiance:g}, {LEAST_SHARE:g} of its maximum or less; the frame's maximum becomes full scale",
                stacklevel=3,
            )
            radiance = peak
    else:
        # Which highlights are isolated is judged without noise first.
        isolated = [h.bp_px for h in judge(points, light, NoiseModel(), peak, 1, seen) if h.isolated]
        radiance = max((_light_at(light, bp_px) for bp_px in isolated), default=peak)
    return radiance / exposure.gain


def _light_at(light: Image, point_px: Array) -> float:
    """Return the light of the pixel that a point, px, lies in."""
    column, row = (min(int(v), size - 1) for v, size in zip(point_px, light.shape[::-1], strict=True))
    return float(light[row, column])
