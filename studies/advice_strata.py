"""Whether `simtest advise` would gain by drawing walls in strata of abs(1 + d k), from the frames of `studies.advice`.

    python -m studies.advice_strata OUT [--rig NAME]...

OUT is the folder of `studies.advice`. The mean error of a method is a ratio, the sum of all errors over the number of
answers, and its variance is that of z = errors - mean * answers over the frames. Two figures are printed for a rig's
best method. *Between* is the share of the variance of z that lies between `STRATA` equal strata of the smaller
abs(1 + d k): all that strata could remove, with the range of 95 % of random orders beside it. *Weighted* is the
variance with the best number of frames in each stratum, weighted [Neyman, J. R. Stat. Soc. 97, 1934, 558], over that
of plain draws; the spreads in it are those of the same frames, so it flatters.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from simtest.advice.advise import MAIN
from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.runtime.files import read_json
from simtest.spec import load_experiment

STRATA = 8

ORDERS = 1000
"""Random orders."""

K1, K2, DISTANCE = "surface.k1_per_mm", "surface.k2_per_mm", "surface.distance_mm"


@dataclass(frozen=True)
class Gain:
    """What strata of an order gain.

    Parameters
    ----------
    between : float
        Share of the variance that lies between strata; below 0 where it is less than chance gives.
    chance : (float, float)
        Its range over 95 % of random orders.
    weighted : float
        Variance with the best number of frames in each stratum, over that of plain draws.
    """

    between: float
    chance: tuple[float, float]
    weighted: float


def gain(totals: Array, counts: Array, order: Array, seed: int = 0) -> Gain:
    """Compute what strata of an order gain for the mean of all values.

    Parameters
    ----------
    totals, counts : ndarray, shape (F,)
        Sum and number of the values of each frame, 0 where it has none.
    order : ndarray, shape (F,)
        Number that frames are ordered by.
    seed : int
        Of the random orders.
    """
    z = totals - totals.sum() / counts.sum() * counts
    whole = np.var(z, ddof=1)
    rng = np.random.default_rng(seed)
    by_chance = [_between(z, rng.uniform(size=len(z))) for _ in range(ORDERS)]
    low, high = np.quantile(by_chance, [0.025, 0.975])
    spreads = np.array([np.std(part, ddof=1) for part in _parts(z, order)])
    return Gain(_between(z, order), (float(low), float(high)), float(np.mean(spreads) ** 2 / whole))


def _parts(z: Array, order: Array) -> list[Array]:
    return np.array_split(z[np.argsort(order, kind="stable")], STRATA)


def _between(z: Array, order: Array) -> float:
    within = np.mean([np.var(part, ddof=1) for part in _parts(z, order)])
    return float(1 - within / np.var(z, ddof=1))


def frames_of(folder: Path, method: str) -> Array:
    """Return sum and number of the errors of a method, and the smaller abs(1 + d k), of each frame; shape (3, F)."""
    (pool,) = load_experiment(folder / MAIN).groups[0].pool
    distance = np.array(pool[DISTANCE], dtype=float)
    turns = [np.abs(1 + distance * np.array(pool[key], dtype=float)) for key in (K1, K2)]
    rows = pl.read_parquet(folder / "run" / "results.parquet")
    answered = (pl.col("status") == "ok") & pl.col("true_id").is_not_null() & (pl.col("estimator") == method)
    own = rows.filter(answered).drop_nulls("error_fine_deg")
    numbers, errors = own["realisation"].to_numpy(), own["error_fine_deg"].to_numpy()
    totals = np.bincount(numbers, errors, minlength=len(distance))
    return np.stack([totals, np.bincount(numbers, minlength=len(distance)), np.min(turns, axis=0)])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("out", type=Path)
    parser.add_argument("--rig", action="append", dest="names")
    told = parser.parse_args()
    try:
        done = read_json(told.out / "advice.json", "what studies.advice writes")
    except InputError as error:
        raise SystemExit(str(error)) from None
    for name in told.names or done:
        method = next(row["method"] for row in done[name]["figures"] if row["target"] == "fine")
        # Finished runs alone: a run that goes on has no table yet.
        runs = [path.parents[1] for path in sorted((told.out / name).rglob("results.parquet"))]
        totals, counts, least = np.concatenate([frames_of(run, method) for run in runs], axis=1)
        made = gain(totals, counts, least)
        low, high = made.chance
        print(
            f"| `{name}` | `{method}` | {len(totals)} | {made.between:.3f} ({low:.3f} to {high:.3f}) | "
            f"{made.weighted:.2f} |"
        )


if __name__ == "__main__":
    main()
