"""A rendered scene with its true highlights, exposed and ready for the camera's noise; with its truth a labelled frame.

The sensor's frame is data: its exposure puts the brightest highlight at full scale, and a surface without a diffuse
part is black beside it. The preview is no data: the lit surface under its highlights, as an endoscope's automatic
exposure would show it.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.calibration.calibration import mean_channel
from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_MIN_GAIN
from simtest.errors import InputError
from simtest.geometry import Camera, smooth
from simtest.rendering import HighlightPoint, Progress, Radiance, Session, TruthMaps
from simtest.rendering.highlights import radii_px
from simtest.runtime.arrays import Array, Image, Mask, short_repr
from simtest.runtime.files import as_path
from simtest.runtime.seeds import from_integer
from simtest.simulation.highlights import (
    NO_HIGHLIGHT,
    REMEDIES,
    CloudRegions,
    TrueHighlight,
    VisibleHighlight,
    VisibleSpots,
    describe,
    examine,
    find_spots,
    verdicts,
)
from simtest.simulation.sensor import capture, check_codec, collect, full_scale_of_average, noise_at, overlaid, to_uint8
from simtest.spec import Scene
from simtest.surfaces.recipe import Polyp

DARK_SHARE = 1e-12
"""A percentile of the radiance that is no more than this share of its maximum is darkness, and sets no exposure."""

DRAWS, FEW_DRAWS = 32, 4
"""Draws of the noise at the peaks of highlights that are isolated if they stand above it, and at all others."""

DEAR_SAMPLES = 16
"""With so many samples a pixel or fewer, a frame with a source of finite size costs no more than its quick look. A part
of what a dataset's seed means: another number keeps other draws."""

Covering = npt.NDArray[np.uint8] | None

STOOL, BILE, DRAWN, COVERED = 1, 2, 3, "covered by stool or by what is drawn"
"""What may cover tissue, and why a point below the first or the last is no isolated highlight."""

TISSUE = np.array([0.55, 0.27, 0.22], dtype=np.float32)
"""Colour of a surface that has none of its own, linear."""

SURFACE_LEVEL, BRIGHT_QUANTILE = 0.3, 0.9
"""Where the surface's light at this quantile lies, share of full scale."""

BLACK_SHARE = 1e-3
"""With less diffuse light than this share of the brightest highlight a surface counts as black."""


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
        All of them, including those that do not count; on a relief these are the glints.
    clouds : list of HighlightPoint
        Highlight points of the base, around which the glints lie; on a smooth surface the highlights themselves.
    full_scale : float
        Radiance behind the lens that becomes 1 (`Exposure`); 0 where no light reaches the sensor.
    calibration : Calibration
        What reconstruction is told.
    instruments : ndarray of uint8, shape (H, W), or None
        1 + the index of the instrument that is seen, 0 where none is; None in a scene without instruments.
    covering : ndarray of uint8, shape (H, W), or None
        What covers the tissue: 1 stool, 2 bile, 3 what is drawn, 0 nothing; None in a scene without any.
    """

    scene: Scene
    radiance: Radiance
    light: Image
    highlights: list[TrueHighlight]
    clouds: Sequence[HighlightPoint]
    full_scale: float
    calibration: Calibration
    instruments: npt.NDArray[np.uint8] | None = None
    covering: Covering = None

    __repr__ = short_repr

    @property
    def camera(self) -> Camera:
        """The camera's calibration."""
        return self.calibration.camera

    @property
    def is_rough(self) -> bool:
        """Whether the surface carries a relief."""
        return self.scene.surface.relief is not None

    @property
    def isolated(self) -> int:
        """How many isolated highlights it shows."""
        return sum(highlight.isolated for highlight in self.highlights)

    @cached_property
    def lobe(self) -> Image:
        """Mean of the channels of the lobe's direct light before the lens, shape (H, W)."""
        return mean_channel(self.radiance.specular)

    @cached_property
    def _specular(self) -> Image:
        """The lobe's light behind the lens, shape (H, W) or (H, W, 3)."""
        return collect(self.radiance.specular, self.scene.sensor, self.camera)

    @cached_property
    def _judged_light(self) -> Image:
        """The light behind the lens that labels are judged by (`_direct`), shape (H, W) or (H, W, 3)."""
        return _direct(self.radiance, self.light, self.scene, self.camera)

    @cached_property
    def spots(self) -> VisibleSpots:
        """The pixels of the spots that can be seen in the noise-free frame, also of those on instruments."""
        seen = _undrawn(self.camera, self.covering)
        return find_spots(mean_channel(self._judged_light), mean_channel(self._specular), seen)

    @cached_property
    def visible_highlights(self) -> list[VisibleHighlight]:
        """The spots that can be seen in the noise-free frame, the brightest first (theory.md 7.1b)."""
        light, spots, sensor = self._judged_light, self.spots, self.scene.sensor
        sigma = noise_at(light, self.full_scale, sensor, spots.rows, spots.columns, FEW_DRAWS)
        clip = self.full_scale if sensor.clips else math.inf
        seen = _undrawn(self.camera, self.covering)
        return describe(spots, light, self._specular, sigma, self.highlights, seen, self.instruments, clip)

    def frame(self, seed: int) -> Image:
        """Return the sensor's frame with the noise of a seed."""
        return capture(self.light, self.full_scale, self.scene.sensor, from_integer(seed), self.camera.seen)


@dataclass(frozen=True, kw_only=True, repr=False)
class LabelledFrame(RenderedView):
    """A rendered frame with its ground truth: a `RenderedView` with the sensor's frame and the truth of each pixel.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W) or (H, W, 3)
        The sensor's frame, full scale 1, as encoded by the sensor's response.
    truth : TruthMaps
        At each pixel's centre, camera frame.
    world_from_camera : ndarray, shape (4, 4)
        The camera's pose, mm; the world is the surface's own frame.
    variant : str
        Mitsuba variant.
    polyps : sequence of Polyp
        Those of the surface, seen or not, in the order of `truth.polyp`.

    Examples
    --------
    >>> import simtest
    >>> frame = simtest.render("sphere", width=96, height=96)
    >>> found = simtest.reconstruct(frame.image, frame.calibration)
    >>> float(found[0].estimates["cone_axis"].normal @ frame.highlights[0].normal) > 0.999
    True
    """

    image: Image
    truth: TruthMaps
    world_from_camera: Array
    variant: str
    polyps: Sequence[Polyp] = ()

    @property
    def advice(self) -> str:
        """What to change where the frame shows no highlight; else empty."""
        return "" if self.highlights else f"{NO_HIGHLIGHT}: {REMEDIES[NO_HIGHLIGHT]}"

    def write(self, folder: str | Path) -> list[Path]:
        """Write the files of `simtest render` into a folder, made if need be; return them."""
        from simtest.simulation.frame_files import write_frame

        return write_frame(self, as_path(folder, "folder"))

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the lit surface with its highlights, and what was rendered."""
        from simtest.pages.notebook import note_html, picture_html

        what = "isolated highlight" if self.isolated == 1 else "isolated highlights"
        text = (
            f"{self.scene.name}: {self.scene.surface.type}, {self.scene.reflectance.type}; "
            f"{self.camera.width} x {self.camera.height} px; {self.isolated} {what}. "
            "Exposed for the eye; `image` holds the data."
        )
        return picture_html(preview(self), text) + note_html(text)


def make_frame(scene: Scene, variant: str | None = None, progress: Progress | None = None) -> LabelledFrame:
    """Render a labelled frame (see `simtest.render`)."""
    check_codec(scene.sensor.coding)
    session = Session(scene, variant, labelled=True)
    # The frame's labels are not used, but the truth starts from their hits.
    radiance = session.frame(progress).radiance
    truth = session.truth()
    if not truth.mask.any():
        raise InputError(f"scene {scene.name}: no pixel sees the surface; move it, or widen the field of view")
    view = render_view(session, scene, radiance)
    return LabelledFrame(
        **{field.name: getattr(view, field.name) for field in fields(view)},
        image=view.frame(scene.sensor.seed),
        truth=truth,
        world_from_camera=session.surface.model_from_camera,
        variant=session.variant,
        polyps=session.surface.at_rest.polyps,
    )


def render_view(session: Session, scene: Scene, radiance: Radiance | None = None) -> RenderedView:
    """Move a session to a scene, render it, unless its radiance is given, and judge its highlights."""
    check_codec(scene.sensor.coding)
    session.update(scene)
    if radiance is None:
        radiance = session.radiance()
    light = collect(radiance.total, scene.sensor, session.camera)
    covering = _covering(session, scene)
    highlights, full_scale = _judged(session, scene, radiance, light, covering)
    highlights, clouds = _placed(session, radiance, highlights, covering)
    # What reconstruction is told may include the distance of the brightest highlight.
    calibration = scene.calibration(brightest_mm(highlights))
    cover = session.cover()
    instruments = None if cover is None else cover.numbers
    return RenderedView(scene, radiance, light, highlights, clouds, full_scale, calibration, instruments, covering)


def brightest_mm(highlights: Sequence[TrueHighlight]) -> float | None:
    """Return the distance of the brightest lit highlight, mm; None where none is lit."""
    lit = [highlight for highlight in highlights if highlight.lit]
    return max(lit, key=lambda highlight: highlight.radiance).distance if lit else None


def render_picture(session: Session, scene: Scene, radiance: Radiance | None = None) -> Image:
    """Return the sensor's frame of a scene: that of `render_view`, without its highlights.

    They are searched only where they set the exposure. With a `radiance` the session stands at a scene that differs
    from this one in nothing but its sensor; else it is moved there.
    """
    if radiance is None:
        session.update(scene)
        radiance = session.radiance()
    light, seen = collect(radiance.total, scene.sensor, session.camera), session.camera.seen
    full_scale = _metered(scene, mean_channel(light), seen)
    if full_scale is None:
        full_scale = _judged(session, scene, radiance, light, _covering(session, scene))[1]
    return capture(light, full_scale, scene.sensor, from_integer(scene.sensor.seed), seen)


def quick_look(scene: Scene) -> Scene | None:
    """Return a scene with one sample a pixel and direct light; None where its frame is no cheaper than the scene's.

    It is not where a source of finite size is sampled by as many points at each centre as in the whole pixel: then the
    frame that is kept is judged itself.
    """
    effort = scene.render
    wide = any(light.source is not None for light in scene.rig.lights)
    if effort.path_depth <= 2 and wide and effort.samples_per_pixel <= DEAR_SAMPLES:
        return None
    return scene.model_copy(update={"render": effort.model_copy(update={"samples_per_pixel": 1, "path_depth": 2})})


def shows_isolated(session: Session, scene: Scene, least: int, rendered: bool = True) -> bool:
    """Move a session to a scene, and return whether its frame shows at least so many isolated highlights.

    The frame is rendered, with its labels, only where so many highlight points may be isolated at all; where it is not
    to be `rendered`, that is the answer, and no frame of a scene for which it is false shows as many.
    """
    session.update(scene)
    if sum(point.lit and not point.min_gain <= HIGHLIGHT_MIN_GAIN for point in session.highlights()) < least:
        return False
    if not rendered:
        return True
    radiance = session.labelled_radiance()
    light = collect(radiance.total, scene.sensor, session.camera)
    highlights, _ = _judged(session, scene, radiance, light, _covering(session, scene))
    return sum(highlight.isolated for highlight in highlights) >= least


def _direct(radiance: Radiance, light: Image, scene: Scene, camera: Camera) -> Image:
    """Return the light behind the lens without bounces, whose noise is the renderer's: labels are judged by it alone.

    `light` is the whole, and is returned where there are no bounces.
    """
    if scene.render.path_depth <= 2:
        return light
    return collect(radiance.specular + radiance.diffuse, scene.sensor, camera)


def _covering(session: Session, scene: Scene) -> Covering:
    """Return what covers the tissue (`RenderedView.covering`)."""
    if not scene.is_covered:
        return None
    covering = np.zeros((session.camera.height, session.camera.width), dtype=np.uint8)
    if (shares := session.debris()) is not None:
        covering[shares[1] > 0.5] = BILE
        covering[shares[0] > 0.5] = STOOL
    if scene.sensor.overlay is not None:
        covering[overlaid(scene.sensor.overlay, covering.shape)] = DRAWN
    return covering


def _undrawn(camera: Camera, covering: Covering) -> Mask | None:
    """Return the pixels of the view on which nothing is drawn; None where these are all."""
    drawn = None if covering is None else covering != DRAWN
    return camera.seen if drawn is None else drawn if camera.seen is None else camera.seen & drawn


def _uncovered(points: Sequence[HighlightPoint], covering: Covering) -> tuple[list[HighlightPoint], list[bool]]:
    """Return points, hidden and not lit where stool or what is drawn covers their pixels, and whether it does."""
    if covering is None:
        return list(points), [False] * len(points)
    last = [covering.shape[1] - 1, covering.shape[0] - 1]
    pixels = [np.minimum(point.bp_px.astype(int), last) for point in points]
    covered = [covering[row, column] not in (0, BILE) for column, row in pixels]
    return [replace(p, lit=False, hidden=True) if over else p for p, over in zip(points, covered, strict=True)], covered


def _judged(
    session: Session, scene: Scene, radiance: Radiance, light: Image, covering: Covering
) -> tuple[list[TrueHighlight], float]:
    """Judge a frame's highlights by its direct light behind the lens; return them and the full scale.

    The session is at the scene, or at one that differs from it in nothing but its sensor.
    """
    camera = session.camera
    direct = _direct(radiance, light, scene, camera)
    (points, covered), seen = _uncovered(session.highlights(radiance), covering), _undrawn(camera, covering)
    rough = session.surface.relief is not None
    examined = examine(points, mean_channel(direct), seen, single=rough)
    examined = [replace(e, why_not=COVERED) if over else e for e, over in zip(examined, covered, strict=True)]
    full_scale = _metered(scene, mean_channel(light), camera.seen)
    if full_scale is None:
        # Which highlights are isolated is judged without noise first.
        mean = mean_channel(direct)
        shown = [h.bp_px for h in verdicts(points, examined, np.zeros(len(points))) if h.isolated]
        pixels = np.minimum(np.array(shown).reshape(-1, 2).astype(int), [mean.shape[1] - 1, mean.shape[0] - 1])
        peak = float(mean.max()) or float(mean_channel(light).max())
        full_scale = max(mean[pixels[:, 1], pixels[:, 0]].tolist(), default=peak) / scene.sensor.exposure.gain
    sigmas = np.zeros(len(points))
    for draws, indices in (
        (DRAWS, [i for i, each in enumerate(examined) if not each.why_not]),
        (FEW_DRAWS, [i for i, each in enumerate(examined) if each.why_not and each.height is not None]),
    ):
        rows, columns = np.array([examined[i].peak for i in indices], dtype=int).reshape(-1, 2).T
        sigmas[indices] = noise_at(direct, full_scale, scene.sensor, rows, columns, draws)
    clip = full_scale if scene.sensor.clips else math.inf
    if direct.ndim == 3 and direct.max() > clip:
        # Tissue's red is clipped long before its green: each channel shows the height that is left to it.
        limited = smooth(mean_channel(np.minimum(direct, np.float32(clip))), DEFAULT_SMOOTHING_PX, seen)
        examined = [each.clipped(limited, seen) for each in examined]
    return verdicts(points, examined, sigmas, clip), full_scale


def _placed(
    session: Session, radiance: Radiance, highlights: list[TrueHighlight], covering: Covering
) -> tuple[list[TrueHighlight], Sequence[HighlightPoint]]:
    """Return highlights with their radii and the numbers of their clouds, and the clouds' centres."""
    radii = radii_px(session, highlights)
    if session.surface.relief is None:
        placed = [replace(h, radius_px=float(radii[i]), cloud=i) for i, h in enumerate(highlights)]
        return placed, placed
    centres, _ = _uncovered(session.base_highlights(radiance), covering)
    numbers: list[int | None] = []
    if highlights:
        lights, pixels = np.array([h.light for h in highlights]), np.array([h.bp_px for h in highlights])
        numbers = CloudRegions.of(session, centres).assign(lights, pixels)
    placed = [
        replace(h, radius_px=float(radius), cloud=number)
        for h, radius, number in zip(highlights, radii, numbers, strict=True)
    ]
    return placed, centres


def _metered(scene: Scene, light: Image, seen: Mask | None) -> float | None:
    """Return the radiance that becomes 1, by the frame's light alone; None where its highlights set it.

    It is 0, with a warning, where there is no light at all.
    """
    exposure, peak = scene.sensor.exposure, float(light.max())
    if peak <= 0:
        warnings.warn(f"scene {scene.name}: no light reaches the sensor; its frame is dark", stacklevel=4)
        return 0.0
    if exposure.full_scale is not None:
        radiance = exposure.full_scale
    elif exposure.average is not None:
        inside, weights = np.ones(light.shape, dtype=bool) if seen is None else seen, None
        if exposure.centre is not None:
            places = np.argwhere(inside)
            scale = exposure.centre * math.hypot(*light.shape) / 2
            weights = np.exp(-((places - places.mean(axis=0)) ** 2).sum(axis=1) / (2 * scale**2))
        radiance = full_scale_of_average(light[inside], exposure.average, scene.sensor, weights)
    elif exposure.percentile is not None:
        radiance = float(np.percentile(light if seen is None else light[seen], exposure.percentile))
        if radiance <= DARK_SHARE * peak:
            warnings.warn(
                f"scene {scene.name}: sensor.exposure.percentile = {exposure.percentile:g}: that of the radiance is "
                f"{radiance:g}, {DARK_SHARE:g} of its maximum or less; the frame's maximum becomes full scale",
                stacklevel=4,
            )
            radiance = peak
    else:
        return None
    return radiance / exposure.gain


def preview(frame: LabelledFrame) -> npt.NDArray[np.uint8]:
    """Return a frame for the eye, sRGB of 8 bits, shape (H, W, 3) (see `expose_for_eye`)."""
    radiance, truth = frame.radiance, frame.truth
    matt = matt_light(truth.position, truth.normal_base, np.asarray(frame.scene.rig.true_mm(), dtype=float))
    diffuse = coloured(radiance.diffuse + radiance.indirect)
    return to_uint8(expose_for_eye(coloured(radiance.specular), diffuse, matt, truth.mask))


def expose_for_eye(specular: Image, diffuse: Image, matt: Image, mask: Mask) -> Image:
    """Return linear light for the eye, shape (..., 3), in which the surface, where `mask` is, is lit.

    A surface whose `diffuse` and bounced light is not black beside the specular one is exposed as a whole. Else it
    gets the light of a matt surface of `TISSUE`, by that of a white one (`matt_light`), to which the specular light is
    added with its brightest point at full scale.
    """
    peak = float(specular.max())
    is_black = float(diffuse.max()) <= BLACK_SHARE * peak
    surface = matt[..., None] * TISSUE if is_black else diffuse
    lit = surface.mean(axis=-1)[mask]
    level = float(np.quantile(lit, BRIGHT_QUANTILE)) if lit.size else 0.0
    exposure = SURFACE_LEVEL / level if level > 0 else 1.0
    return np.asarray(exposure * surface + specular * (1 / max(peak, 1e-30) if is_black else exposure), np.float32)


def matt_light(position: Array, normal: Array, lights: Array) -> Image:
    """Return the light of a white matt surface under lights, shape (L, 3), mm: relative, shape (...).

    It is Lambert's cosine over the squared distance; 0 where there is no surface.
    """
    total = np.zeros(position.shape[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        for light in lights:
            way = light - position
            total += np.maximum((normal * way).sum(axis=-1), 0) / np.linalg.norm(way, axis=-1) ** 3
    return np.nan_to_num(total).astype(np.float32)


def coloured(values: Image) -> Image:
    """Return light with three channels, shape (H, W, 3)."""
    return np.repeat(values[:, :, None], 3, axis=2) if values.ndim == 2 else values
