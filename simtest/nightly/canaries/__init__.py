"""Canaries: figures whose value is known, which see faults that the errors of a run do not show.

Expected values are made without the code that is watched: closed forms, formulas written down anew in plain NumPy, and
numbers that other programs measured. `geometry`, `lenses` and `sensors` render nothing; `rendered`, `reflections`,
`tissues` and `labels` check radiance, truth and files; `tables`, `estimates`, `seeds` and `randomness` what is made of
them. `by_hand` holds what several of them compare with.
"""

from collections.abc import Callable
from functools import cache, partial

import polars as pl

from simtest.errors import BackendError
from simtest.nightly.canaries import (
    estimates,
    geometry,
    labels,
    lenses,
    reflections,
    rendered,
    seeds,
    sensors,
    tables,
    tissues,
)
from simtest.nightly.canaries import randomness as noise
from simtest.nightly.canaries.canary import or_failed_canary
from simtest.nightly.records import Figure, figure_table
from simtest.rendering import Session

__all__ = ["measures", "run_canaries"]

ALONE = (
    geometry.sightlines, geometry.conditioning, geometry.ellipse, geometry.pose, geometry.isophotes, noise.published,
    noise.protocol_noise,
    lenses.lenses, lenses.view_masks, lenses.camera_files, lenses.rigs,
    sensors.photon_noise, sensors.stated_noise, sensors.curves, sensors.quantisation, sensors.vignetting,
    sensors.widths,
    seeds.branches, tables.statistics, tables.law_values, estimates.coverage, estimates.budgets,
    labels.encodings, tissues.translucency, tissues.glints,
)  # fmt: skip
IN_SESSION = (
    rendered.photometry, rendered.exposure, rendered.truth,
    rendered.plane_errors, rendered.told_light, rendered.curved_errors, rendered.rotated,
    reflections.lobes, reflections.emission, labels.surfaces, labels.frame_files,
    tables.counts, tables.columns, tables.thresholds, tissues.relief,
)  # fmt: skip
BY_VARIANT = (noise.noises, lenses.lens_rays, reflections.bounces, labels.dataset)


def run_canaries(rows: pl.DataFrame | None = None, variant: str | None = None) -> pl.DataFrame:
    """Measure all canaries, of the noise of some results too, where there are any.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, kind "canary". One that an error stops has no value, and has not passed; its `about` holds
        the error.

    Raises
    ------
    BackendError
        If the rendering backend cannot be used.
    """
    measured = measures(variant)
    if rows is not None:
        measured["noises_of"] = partial(_table, partial(noise.noises_of, rows))
    # Without a backend there is no run; any other error fails its canary.
    return pl.concat(or_failed_canary(name, own, (BackendError,)) for name, own in measured.items())


def measures(variant: str | None = None) -> dict[str, Callable[[], pl.DataFrame]]:
    """Return what measures the canaries, by name, each its own; those that need one share a rendering session."""

    @cache
    def session() -> Session:
        return Session(rendered.described(rendered.PLANE), variant)

    made: dict[str, Callable[[], list[Figure]]] = {measure.__name__: measure for measure in ALONE}
    made |= {measure.__name__: partial(_in, session, measure) for measure in IN_SESSION}
    made |= {measure.__name__: partial(measure, variant) for measure in BY_VARIANT}
    return {name: partial(_table, own) for name, own in made.items()}


def _in(session: Callable[[], Session], measure: Callable[[Session], list[Figure]]) -> list[Figure]:
    return measure(session())


def _table(measure: Callable[[], list[Figure]]) -> pl.DataFrame:
    return figure_table(measure())
