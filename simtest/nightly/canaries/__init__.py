"""Canaries: figures whose value is known, which see faults that the errors of a run do not show.

`geometry` renders nothing, `rendered` checks radiance and truth, `randomness` the noise; `by_hand` holds the formulas
written down anew that they compare with.
"""

from collections.abc import Callable
from functools import cache, partial

import polars as pl

from simtest.errors import BackendError
from simtest.nightly.canaries import geometry, rendered
from simtest.nightly.canaries import randomness as noise
from simtest.nightly.canaries.canary import or_failed_canary
from simtest.nightly.records import Figure, figure_table
from simtest.rendering import Session

__all__ = ["run_canaries"]

ALONE = (geometry.sightlines, geometry.conditioning, geometry.pose, geometry.isophotes, noise.published)
IN_SESSION = (rendered.photometry, rendered.truth, rendered.plane_errors, rendered.curved_errors, rendered.rotated)


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

    @cache
    def session() -> Session:
        return Session(rendered.described(rendered.PLANE), variant)

    measured: dict[str, Callable[[], list[Figure]]] = {measure.__name__: measure for measure in ALONE}
    measured |= {measure.__name__: partial(_in, session, measure) for measure in IN_SESSION}
    measured["noises"] = partial(noise.noises, variant)
    if rows is not None:
        measured["noises_of"] = partial(noise.noises_of, rows)
    # Without a backend there is no run; any other error fails its canary.
    return pl.concat(or_failed_canary(name, partial(_table, own), (BackendError,)) for name, own in measured.items())


def _in(session: Callable[[], Session], measure: Callable[[Session], list[Figure]]) -> list[Figure]:
    return measure(session())


def _table(measure: Callable[[], list[Figure]]) -> pl.DataFrame:
    return figure_table(measure())
