"""Makes samples: a scene is drawn and rendered, seen by the sensor, and estimated on."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from pydantic import JsonValue

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.dataset.fields import COVERING, INSTRUMENT, POLYP, VISIBLE, depth_scale_mm
from simtest.dataset.metadata import DetectionMeta, EstimateMeta, HighlightMeta, InstanceMeta, SampleMeta
from simtest.dataset.plan import Anatomy, Drawn, Plan
from simtest.dataset.sample_calibration import calibration_of_picture, stored_picture
from simtest.dataset.shard import Sample, sample_key
from simtest.detection.peaks import Component
from simtest.errors import Failure, InputError
from simtest.estimators import AnyEstimator, load_estimators
from simtest.estimators.names import forgive_cores
from simtest.geometry import ellipse_of_conic, fit_ellipse
from simtest.reconstruction.records import Specularity
from simtest.rendering import Frame, Session, backend
from simtest.rendering.backend import colour_variant
from simtest.runtime.arrays import AnyArray, Image, only_reading
from simtest.simulation.frame import RenderedView, brightest_mm, quick_look, render_view, shows_isolated
from simtest.simulation.highlights import TrueHighlight, cloud_json, lobe_region
from simtest.simulation.sensor import to_uint8
from simtest.spec import describe_camera
from simtest.surfaces import forget_meshes
from simtest.validation.columns import Row
from simtest.validation.realisation import answer, score
from simtest.validation.scoring import of_clouds

UNPLACED = 100
"""Draws that cannot be rendered, beyond the tries, before a sample is given up."""


class Maker:
    """Makes samples of a plan one after the other and keeps the rendering session."""

    def __init__(self, plan: Plan, variant: str | None = None) -> None:
        self.plan = plan
        self._variant = colour_variant(variant)
        self._session: Session | None = None
        self._anatomy: Anatomy | None = None
        self._estimators = load_estimators(plan.dataset.estimators)

    def make(self, index: int) -> Sample:
        """Make a sample; the same index gives the same sample, whatever was made before.

        Raises `InputError` if the drawn scene cannot be rendered.
        """
        forgive_cores()
        drawn, attempt, seen, frame = self._choose(index)
        session = self._at(drawn)
        scene, anatomy = drawn.scene, drawn.anatomy
        # What the stored picture shows to a camera that knows its calibration and nothing of the truth.
        picture = stored_picture(seen.frame(scene.sensor.seed), scene.sensor)
        specularities = answer(seen, picture, self._estimators)
        isolated = [i for i, truth in enumerate(seen.highlights) if truth.isolated]
        lobes = session.lobe_at([seen.highlights[i] for i in isolated]).tolist()
        regions = {i: lobe_region(seen.highlights[i], seen.lobe, at) for i, at in zip(isolated, lobes, strict=True)}
        instance = _instances(seen.lobe.shape, regions)
        images = {"image": picture, **self._images(drawn, seen, frame), "instance": instance}
        areas = np.bincount(instance.ravel(), minlength=len(seen.highlights) + 1)[1:].tolist()
        highlights = [_highlight(truth) for truth in seen.highlights]
        for i, region in regions.items():
            highlights[i]["region"] = _instance_of(region, areas[i], seen.full_scale)
        scored = self.score(index, session, seen, specularities, self._estimators)
        meta: SampleMeta = {
            "key": sample_key(index),
            "index": index,
            "dataset": self.plan.dataset.name,
            "split": self.plan.split(index),
            "anatomy": {
                "family": anatomy.family,
                "number": anatomy.number,
                "seed": anatomy.seed,
                "surface": scene.surface.label,
            },
            "drawn": drawn.values,
            "camera": describe_camera(scene.camera.model()),
            "world_from_camera": session.surface.model_from_camera.tolist(),
            "lights_mm": scene.rig.true_mm().tolist(),
            "brightest_mm": brightest_mm(seen.highlights),
            "full_scale": seen.full_scale,
            "scene": scene.model_dump(mode="json"),
            "attempt": attempt,
            "highlights": highlights,
            "detections": [_detection(specularity) for specularity in specularities],
            "estimates": [_estimate(row) for row in scored],
            "depth_scale_mm": depth_scale_mm(images["depth"]),
        }
        if polyps := session.surface.at_rest.polyps:
            meta["polyps"] = [polyp.model_dump() for polyp in polyps]
        if scene.instruments:
            meta["instrument_share"] = float(np.mean(images[INSTRUMENT] > 0))
        if seen.is_rough:
            meta["clouds"] = cast("list[dict[str, JsonValue]]", [cloud_json(centre) for centre in seen.clouds])
        if seen.is_rough or self.plan.dataset.visible:
            spots = [spot.to_json() for spot in seen.visible_highlights]
            meta["visible_highlights"] = cast("list[dict[str, JsonValue]]", spots)
        return Sample(meta, images)

    def view(self, index: int) -> tuple[Drawn, RenderedView, Session]:
        """Render a sample's scene as `make` does; return it with its view, and the session at it.

        What the view's calibration tells is of the stored picture.
        """
        drawn, _, seen, _ = self._choose(index)
        return drawn, seen, self._at(drawn)

    def _choose(self, index: int) -> tuple[Drawn, int, RenderedView, Frame]:
        """Draw until the frame shows enough isolated highlights; the last draw is taken as it is.

        A draw that cannot be rendered counts as one that shows too few; up to `UNPLACED` more follow the last.
        """
        dataset = self.plan.dataset
        attempt, last = 0, dataset.tries - 1 if dataset.highlights else 0
        while True:
            try:
                chosen = self._tried(self.plan.draw(index, attempt), attempt >= last)
            except InputError:
                # A drawn camera, light or instrument may stand in tissue or in one another.
                if attempt >= last + UNPLACED:
                    raise
                self._session, chosen = None, None
            if chosen is not None:
                drawn, view, frame = chosen
                return drawn, attempt, view, frame
            attempt += 1

    def _tried(self, drawn: Drawn, is_last: bool) -> tuple[Drawn, RenderedView, Frame] | None:
        """Render a draw; None where it shows too few isolated highlights and is not the last."""
        if not (is_last or self._promises(drawn)):
            return None
        session = self._at(drawn)
        frame = session.frame()
        view = render_view(session, drawn.scene, frame.radiance)
        told = calibration_of_picture(drawn.scene, brightest_mm(view.highlights))
        view = replace(view, calibration=told)
        least = self.plan.dataset.highlights
        judged = is_last or quick_look(drawn.scene) is not None
        return (drawn, view, frame) if judged or view.isolated >= least else None

    def _promises(self, drawn: Drawn) -> bool:
        """Return whether a draw is worth its frame: by a quick look, or, where that saves nothing, by geometry."""
        quick = quick_look(drawn.scene)
        scene = drawn.scene if quick is None else quick
        session = self._at(replace(drawn, scene=scene))
        return shows_isolated(session, scene, self.plan.dataset.highlights, rendered=quick is not None)

    def _at(self, drawn: Drawn) -> Session:
        """Return the session, updated to a scene."""
        if self._session is not None and drawn.anatomy != self._anatomy:
            # The next anatomy is another scene, and this one never comes back: memory must not add up.
            self._session = None
            forget_meshes()
            backend.release_memory()
        # For the same reason nothing of it is kept on disk.
        with only_reading():
            if self._session is None:
                self._anatomy = drawn.anatomy
                self._session = Session(drawn.scene, self._variant, labelled=True)
            self._session.update(drawn.scene)
        return self._session

    def score(
        self, index: int, session: Session, seen: RenderedView, answers: Sequence[Specularity],
        estimators: Mapping[str, AnyEstimator],
    ) -> list[Row]:  # fmt: skip
        """Score the answers to a sample, at whose scene the session is; true_id is the index in the list of all."""
        scene = session.scene
        common: Row = {"experiment": self.plan.dataset.name, "label": scene.surface.label, "realisation": index,
                       "setting": self.plan.split(index), "seed": scene.sensor.seed}  # fmt: skip
        made, clouds = score(session, seen, answers, estimators, common), of_clouds(estimators)
        return [
            row | {"true_id": made.counted[number]}
            if isinstance(number := row.get("true_id"), int) and row["estimator"] not in clouds
            else row
            for row in made.rows
        ]

    def _images(self, drawn: Drawn, seen: RenderedView, frame: Frame) -> dict[str, AnyArray]:
        radiance, scale, images = seen.radiance, seen.full_scale or 1.0, self._truth(drawn, frame)
        parts = {"specular": radiance.specular, "diffuse": radiance.diffuse, "indirect": radiance.indirect}
        images |= {name: _share_of(part, scale) for name, part in parts.items()}
        if seen.covering is not None:
            images[COVERING] = seen.covering
        if self.plan.dataset.visible:
            images[VISIBLE] = seen.spots.regions
        if self.plan.dataset.radiance:
            images["radiance"] = _colour(radiance.total / np.float32(scale))
        return images

    def _truth(self, drawn: Drawn, frame: Frame) -> dict[str, AnyArray]:
        seen = self._at(drawn).truth() if self.plan.dataset.exact else frame.labels
        normal, base = seen.normal, seen.normal_base
        if not self.plan.dataset.exact:
            # An interpolated normal may lean away from the camera next to a silhouette; the triangle's own does not.
            # A fine normal may lean away on a sound base, and stays.
            away = np.sum(base * seen.position, axis=-1, keepdims=True) >= 0
            normal, base = (np.where(away, seen.geometric_normal, own) for own in (normal, base))
        truth = {"depth": seen.depth, "normal": normal, "curvature": np.stack([seen.k_min, seen.k_max], axis=-1)}
        if drawn.scene.instruments:
            truth[INSTRUMENT] = seen.instrument
        if seen.polyp is not None:
            truth[POLYP] = seen.polyp
        if drawn.scene.surface.relief is None:
            # The base is the fine surface: it is not stored twice.
            return truth
        curvature_base = np.stack([seen.k_min_base, seen.k_max_base], axis=-1)
        return {**truth, "normal_base": base, "curvature_base": curvature_base, "pool": seen.pool}


def _share_of(part: Image, scale: float) -> AnyArray:
    """Return the 8-bit picture of a part of the radiance; without bounces that of the indirect light is black."""
    encoded = to_uint8(part / np.float32(scale)) if part.any() else np.zeros(part.shape, dtype=np.uint8)
    return _colour(encoded)


def _colour(image: AnyArray) -> AnyArray:
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


LobeRegion = tuple[float, Component | None]
"""A highlight's peak in the lobe's light, and its pixels (`lobe_region`)."""


def _instances(shape: tuple[int, ...], regions: Mapping[int, LobeRegion]) -> npt.NDArray[np.int32]:
    """Return the regions of highlights by index, each as 1 + its index; of overlapping ones the brighter is on top."""
    numbers = np.zeros(shape, dtype=np.int32)
    for i, (_, component) in sorted(regions.items(), key=lambda region: region[1][0]):
        if component is not None:
            height, width = component.mask.shape
            numbers[component.y : component.y + height, component.x : component.x + width][component.mask] = i + 1
    return numbers


def _instance_of(region: LobeRegion, area: int, full_scale: float) -> InstanceMeta:
    """Describe the pixels of an isolated highlight in `instance`, or why there are none."""
    peak, component = region
    missing = "no pixel reaches half height" if component is None else "its pixels are a brighter one's"
    shown = peak / (full_scale or 1.0)
    return {"lobe_peak": shown, "instance_px": area or None, "no_instance": None if area else missing}


def _highlight(truth: TrueHighlight) -> HighlightMeta:
    return cast(HighlightMeta, truth.to_json())


def _estimate(row: Row) -> EstimateMeta:
    """Return a row of results as it is kept: columns without a value are left out."""
    return {key: plain for key, value in row.items() if (plain := _plain(value)) is not None}


def _detection(specularity: Specularity) -> DetectionMeta:
    """Describe a detection: its box, its peak, and the ellipse of its isophote at half height."""
    found: DetectionMeta = {"box_px": [int(v) for v in specularity.region.box], "peak_px": None, "ellipse": None}
    if isinstance(specularity.patch, Failure):
        return found
    found["peak_px"] = specularity.patch.peak_px.tolist()
    # The ellipse is missing if the isophote is open or no ellipse.
    contour = specularity.patch.isophote(HIGHLIGHT_ISOVALUE)
    fitted = contour if isinstance(contour, Failure) else fit_ellipse(contour)
    if not isinstance(fitted, Failure):
        ellipse = ellipse_of_conic(fitted.image)
        found["ellipse"] = {
            "isovalue": HIGHLIGHT_ISOVALUE,
            "centre_px": ellipse.centre.tolist(),
            "semi_axes_px": [ellipse.semi_major, ellipse.semi_minor],
            "angle_deg": math.degrees(ellipse.angle),
        }
    return found


def _plain(value: Any) -> Any:
    """Return a value as JSON holds it: None for numbers that are not finite."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
