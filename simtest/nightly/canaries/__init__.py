"""Canaries: figures whose value is known, which see faults that the errors of a night do not show."""

from collections.abc import Callable, Sequence
from functools import cache, partial

import polars as pl

from simtest.errors import BackendError
from simtest.nightly.canaries import geometry, rendered
from simtest.nightly.canaries import randomness as noise
from simtest.nightly.canaries.record import Canary, as_figures
from simtest.rendering import Session
from simtest.spec import Experiment

__all__ = ["Canary", "run_canaries"]


def run_canaries(
    rows: pl.DataFrame | None = None, variant: str | None = None, seed: int = 0,
    experiments: Sequence[Experiment] | None = None,
) -> pl.DataFrame:  # fmt: skip
    """Measure all canaries.

    Parameters
    ----------
    rows : polars.DataFrame, optional
        Results of the night's experiments, whose noise is looked at too.
    variant : str, optional
        Mitsuba variant.
    seed : int
        Of the noise.
    experiments : sequence of Experiment, optional
        What the rows are of: tells whether they must be noisy.

    Returns
    -------
    polars.DataFrame
        Columns `simtest.nightly.gate.records.FIGURES`, kind "canary". One that cannot be measured for an error has no
        value, and has not passed; its `about` holds the error.

    Raises
    ------
    BackendError
        If the rendering backend cannot be used.
    """

    @cache
    def session() -> Session:
        return Session(rendered.described(rendered.PLANE), variant)

    alone = (geometry.sightlines, geometry.conditioning, geometry.pose, geometry.isophotes, noise.published)
    in_session = (
        rendered.photometry, rendered.truth, rendered.plane_errors, rendered.curved_errors, rendered.rotated
    )  # fmt: skip
    measured: list[Callable[[], list[Canary]]] = [*alone]
    measured += [partial(_in, session, measure) for measure in in_session]
    measured.append(partial(noise.noises, variant, seed))
    if rows is not None:
        measured.append(partial(noise.noises_of, rows, experiments))
    names = [*(measure.__name__ for measure in (*alone, *in_session)), "noises", "noises_of"]
    return as_figures(
        [canary for name, measure in zip(names, measured, strict=False) for canary in _any(name, measure)]
    )


def _in(session: Callable[[], Session], measure: Callable[[Session], list[Canary]]) -> list[Canary]:
    return measure(session())


def _any(name: str, measure: Callable[[], list[Canary]]) -> list[Canary]:
    """Give canaries, or in their place one that says why there are none: a fault may break any of them."""
    try:
        return measure()
    except BackendError:
        raise
    except Exception as error:
        return [Canary(name, "error", "", float("nan"), 0.0, n=0, about=f"{type(error).__name__}: {error}")]
