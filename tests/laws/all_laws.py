"""Laws: numbers that are known beforehand, which see faults that the errors of results do not show.

Expected values are made without the code that is watched: closed forms, formulas written down anew in plain NumPy, and
numbers that other programs measured. `geometry`, `lenses` and `sensors` render nothing; `rendered`, `reflections`,
`tissues` and `labels` check radiance, truth and files; `tables`, `estimates`, `seeds`, `randomness` and `ladder` what
is made of them, `results` the rows of a run. `by_hand` holds what several of them compare with.
"""

from collections.abc import Callable
from functools import cache, partial

from simtest.rendering import Session
from tests.laws import (
    estimates,
    geometry,
    labels,
    ladder,
    lenses,
    randomness,
    reflections,
    rendered,
    seeds,
    sensors,
    tables,
    tissues,
)
from tests.laws.law import Law

ALONE = (
    geometry.sightlines, geometry.conditioning, geometry.ellipse, geometry.pose, geometry.isophotes,
    randomness.published, randomness.protocol_noise,
    lenses.lenses, lenses.view_masks, lenses.camera_files, lenses.rigs,
    sensors.photon_noise, sensors.stated_noise, sensors.curves, sensors.quantisation, sensors.vignetting,
    sensors.widths,
    seeds.branches, tables.statistics, tables.law_values, estimates.coverage, estimates.budgets,
    labels.encodings, tissues.translucency, tissues.glints, ladder.error_ladder,
)  # fmt: skip
IN_SESSION = (
    rendered.photometry, rendered.exposure, rendered.truth,
    rendered.plane_errors, rendered.told_light, rendered.curved_errors, rendered.rotated,
    reflections.lobes, reflections.emission, labels.surfaces, labels.polyps, labels.frame_files,
    tables.counts, tables.columns, tables.thresholds, tissues.relief,
)  # fmt: skip
RENDERING = (randomness.noises, lenses.lens_rays, reflections.bounces, labels.dataset, tissues.debris)


def measures() -> dict[str, Callable[[], list[Law]]]:
    """Return what measures the laws, by name, each its own; those of `IN_SESSION` share a rendering session."""

    @cache
    def session() -> Session:
        return Session(rendered.described(rendered.PLANE))

    made: dict[str, Callable[[], list[Law]]] = {measure.__name__: measure for measure in ALONE}
    made |= {measure.__name__: partial(_in, session, measure) for measure in IN_SESSION}
    return made | {measure.__name__: measure for measure in RENDERING}


def _in(session: Callable[[], Session], measure: Callable[[Session], list[Law]]) -> list[Law]:
    return measure(session())
