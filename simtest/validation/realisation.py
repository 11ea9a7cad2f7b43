"""One realisation: render, expose, reconstruct, match, measure; and the one way to score answers to a view."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from simtest.errors import Reason
from simtest.estimators import AnyEstimator
from simtest.estimators.protocol import laws_of
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.rendering import Session
from simtest.runtime.arrays import Image, Picture, only_reading
from simtest.simulation.frame import RenderedView, render_view
from simtest.simulation.highlights import TrueHighlight
from simtest.spec import Experiment
from simtest.spec.recipes import CoreRegions
from simtest.validation.cases import Case, swept_example
from simtest.validation.columns import Row, Value, swept_columns, table
from simtest.validation.glints import rough_truth
from simtest.validation.kept_frames import MAP_SIDE, KeptEstimate, write_item
from simtest.validation.motion import MOTION, FurtherView, MotionResult, further_views, with_motion
from simtest.validation.scoring import MISSED, apart, cloud_rows, match, of_clouds, on_instruments, peak_px, rows
from simtest.validation.statistics import row_kind


@dataclass(frozen=True)
class Realisation:
    """The outcome of one realisation.

    Parameters
    ----------
    number : int
        Of the realisation.
    view : RenderedView
        The rendered scene.
    rows : list of dict
        Of the results' table.
    frame : ndarray of float32, shape (H, W) or (H, W, 3)
        The sensor's frame, as encoded.
    specularities : list of Specularity
        Detections with estimates.
    truths : list of TrueHighlight
        Those that count.
    matched : dict
        Index of the truth by index of the detection.
    """

    number: int
    view: RenderedView
    rows: list[Row]
    frame: Image
    specularities: list[Specularity]
    truths: list[TrueHighlight]
    matched: dict[int, int]


@dataclass(frozen=True)
class Scored:
    """Answers to a view, scored.

    Parameters
    ----------
    rows : list of dict
        Of the results' table; ``true_id`` is an index in `truths`, of a cloud's row one in the view's `clouds`.
    truths : list of TrueHighlight
        Those that count.
    counted : list of int
        Their indices among the view's highlights.
    matched : dict
        Index of the truth by index of the detection.
    """

    rows: list[Row]
    truths: list[TrueHighlight]
    counted: list[int]
    matched: dict[int, int]


def answer(
    view: RenderedView, frame: Image | Picture, estimators: Mapping[str, AnyEstimator], isolated: bool = True,
    regions: CoreRegions | None = None,
) -> list[Specularity]:  # fmt: skip
    """Reconstruct a view's frame by what is known of it; without light whatever would be found is noise."""
    if view.full_scale <= 0:
        return []
    return reconstruct(frame, view.calibration, estimators, isolated=isolated, detector="peaks", regions=regions)


def score(
    session: Session, view: RenderedView, answers: Sequence[Specularity], estimators: Mapping[str, AnyEstimator],
    common: Row, isolated: bool = True, motion: MotionResult | None = None,
) -> Scored:  # fmt: skip
    """Score answers to a view, at whose scene the session must be: whatever made them, and wherever they are kept.

    Parameters
    ----------
    session, view
        The rendered scene with its truth.
    answers : sequence of Specularity
        Detections with estimates, those of `motion` where it is given.
    estimators : mapping
        What was asked, by name.
    common : dict
        What all rows share.
    isolated : bool
        Whether isolated highlights alone were detected, and count.
    motion : MotionResult, optional
        What further views made of the answers.
    """
    dark = view.full_scale <= 0
    # What is of clouds is judged by the base's highlight points, the rest by the true highlights.
    cloud_names = of_clouds(estimators)
    singles, of_base, refused = apart(answers, cloud_names)
    # Without light no highlight counts as isolated, and all count as failures.
    counted = [i for i, truth in enumerate(view.highlights) if truth.isolated or not isolated or dark]
    truths = [view.highlights[i] for i in counted]
    matched = match(singles, [truth.bp_px for truth in truths])
    rough = None
    if view.is_rough:
        # Detection is scored on what can be seen: the relief melts and hides glints.
        seen = match(singles, [spot.peak_px for spot in view.visible_highlights])
        rough = rough_truth(session, view, counted, seen)
    unfound = str(Reason.NO_LIGHT) if dark else MISSED
    metal = on_instruments(singles, matched, view)
    declared = {name: laws_of(estimator) for name, estimator in estimators.items() if name not in cloud_names}
    # Motion is asked for signs; its normals are those of another estimator.
    declared |= {} if motion is None else {MOTION: ()}
    made = rows(session, common, singles, truths, matched, declared, unfound, rough, metal)
    if motion is not None:
        moved = [row for row in made if row["estimator"] == MOTION]
        for row in moved:
            row |= motion.columns(row, view.scene, truths)
    if cloud_names:
        made += cloud_rows(session, view, common, of_base, refused, {} if rough is None else rough.clouds)
    return Scored(made, truths, counted, matched)


class Realiser:
    """Makes realisations one after the other; session and view stay while the next one can use them.

    Parameters
    ----------
    variant : str or None
        Mitsuba variant.
    """

    def __init__(self, variant: str | None) -> None:
        self.variant = variant
        self._view: RenderedView | None = None
        self._further: list[FurtherView] = []

    def make(
        self, experiment: Experiment, case: Case, number: int, estimators: Mapping[str, AnyEstimator]
    ) -> Realisation:
        """Make one realisation of a case; `session` is then at its scene."""
        view, drawn = self.view(experiment, case, number)
        return realise(self.session, experiment, case, number, view, drawn, estimators, self._further)

    def view(self, experiment: Experiment, case: Case, number: int) -> tuple[RenderedView, dict[str, float]]:
        """Render the scene of a realisation, at which `session` then is; return it with the values drawn for it."""
        scene, drawn = case.scene(experiment, number)
        # Reliefs of tens of megabytes that no other frame has would push the anatomies out of the user's cache.
        with only_reading("relief") if case.has_own_relief else nullcontext():
            # A scene without drawn values is rendered once for all realisations.
            if self._view is None:
                self.session = Session(scene, self.variant)
            if self._view is None or scene != self._view.scene:
                self._further = further_views(self.session, scene)
                self._view = render_view(self.session, scene)
        return self._view, drawn


def realise(
    session: Session, experiment: Experiment, case: Case, number: int, view: RenderedView, drawn: Mapping[str, Value],
    estimators: Mapping[str, AnyEstimator], further: Sequence[FurtherView] = (),
) -> Realisation:  # fmt: skip
    """Make one realisation of a case from its rendered view, at whose scene the session must be.

    `drawn` holds the values drawn for this realisation, by key path, `estimators` the estimators by name, and `further`
    the further views of an experiment on motion.
    """
    seed = case.noise_seed(experiment, number)
    frame = view.frame(seed)
    specularities = answer(view, frame, estimators, case.isolated, experiment.regions)
    motion = with_motion(experiment, case, number, view, further, specularities) if further else None
    specularities = specularities if motion is None else motion.specularities
    common: Row = {
        "experiment": experiment.name,
        "label": case.label,
        "realisation": number,
        "setting": case.setting,
        "seed": seed,
        "laws": ",".join(case.laws) or None,
        **swept_columns({**case.swept, **drawn}),
    }
    made = score(session, view, specularities, estimators, common, case.isolated, motion)
    return Realisation(number, view, made.rows, frame, specularities, made.truths, made.matched)


def keep_frame(path: Path, session: Session, experiment: Experiment, case: Case, realisation: Realisation) -> None:
    """Keep the frame of a realisation, at whose scene the session must be."""
    scene = realisation.view.scene
    # Errors and counts are those of the results: a cloud's truth is the base's, and none of the highlights here.
    held = table(realisation.rows, swept_example([case], experiment.regions))
    rows = {
        (row["specularity"], row["estimator"]): {name: row[name] for name in ("kind", "error_deg", "error_oracle_deg")}
        for row in held.with_columns(kind=row_kind(held)).iter_rows(named=True)
    }
    # Thinned maps: enough for arrows and the 3D view.
    truth = session.truth(stride=max(1, max(session.camera.width, session.camera.height) // MAP_SIDE))
    meta = {
        "surface": scene.surface.label,
        "setting": case.setting if not case.part else f"{case.setting} (part {case.part})",
        "label": case.label,
        "sigma": scene.sensor.noise_sigma,
        "command": case.reproduce_command(experiment, realisation.number),
        "camera": session.camera,
        "truth": [
            {
                "id": number, "bp_px": each.bp_px.tolist(), "normal": each.normal.tolist(),
                "position": each.position.tolist(), "kd_min": each.kd_min, "kd_max": each.kd_max,
                "isolated": each.isolated,
            }
            for number, each in enumerate(realisation.truths)
        ],
        "estimates": [
            KeptEstimate(
                specularity=i, true_id=realisation.matched.get(i), bp_px=peak_px(specularity).tolist(), estimator=name,
                **rows.get((i, name), {"kind": "failed"}),
            ).answered(result, specularity.patch, session.camera)
            for i, specularity in enumerate(realisation.specularities)
            for name, result in specularity.estimates.items()
        ],
        "lights": scene.rig.true_mm().tolist(),
    }  # fmt: skip
    # Pictures are encoded once more where they are drawn.
    linear = scene.sensor.response.model().decode(realisation.frame)
    write_item(path, meta, linear, truth.position, truth.normal, curvature=truth.larger_curvature)
