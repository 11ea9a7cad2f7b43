"""What a reader of the verdict must know beside its comparisons."""

from collections.abc import Mapping
from typing import Any

import polars as pl

from simtest.nightly.gate.limits import Limits
from simtest.nightly.gate.pairing import changes
from simtest.nightly.gate.quantities import ANSWERED
from simtest.nightly.gate.records import PLACE, POOLED, Night

_FAR, _FAR_DEG = 10, 1.0
"""A rise of so many margins, and of so many degrees, is told even where nothing can be decided."""

_FOLLOWS = {"Versions": "All places were compared unpaired.", "The processor": "Costs were not judged."}


def redefined(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Name the experiments whose definition is known in both records, and another.

    Parameters
    ----------
    before, after : mapping
        `Night.run`; `definitions` is a hash by experiment, or missing where it is not known.
    """
    first, second = (dict(run.get("definitions") or {}) for run in (before, after))
    return sorted(name for name in first.keys() & second.keys() if first[name] != second[name])


def large_and_undecided(comparisons: pl.DataFrame) -> tuple[str, ...]:
    """Say where a single realisation rose so much that a reader must look, though one number decides nothing.

    Parameters
    ----------
    comparisons : polars.DataFrame
        Columns `COMPARISONS`.
    """
    errors = pl.col("quantity").is_in(["mean_deg", "mean_penalised_deg"]) & (pl.col("setting") != POOLED)
    far = (pl.col("difference") > _FAR * pl.col("margin")) & (pl.col("difference") > _FAR_DEG)
    found = comparisons.filter(errors & far, pl.col("n") == 1, pl.col("outcome") == "undecided")
    count = found.select(PLACE).n_unique()
    if not count:
        return ()
    return (
        f"At {count} places of one realisation the error rose by more than {_FAR} margins and {_FAR_DEG:g} deg, by "
        f"{float(found['difference'].to_numpy().max()):.2g} deg at most: too few to decide, look at them.",
    )


def notes_on(
    baseline: Night, tonight: Night, bit_equal: bool, unmatched: int, short: int, limits: Limits
) -> tuple[str, ...]:
    """Say in what two nights differ beside their numbers.

    Parameters
    ----------
    baseline, tonight : Night
        The nights.
    bit_equal : bool
        Whether all results are the same bytes.
    unmatched : int
        Places whose results differ and whose rows are no exact pairs.
    short : int
        Places that have lost highlights of the baseline.
    limits : Limits
        `medians_deg`.

    Returns
    -------
    tuple of str
        Plain sentences.
    """
    made = [_other("Versions", *_differing(baseline.run, tonight.run))]
    made.append(_other("The processor", baseline.run.get("processor"), tonight.run.get("processor")))
    for key in ("profile", "variant", "llvm", "python"):
        # A record that does not have it says nothing of it.
        if baseline.run.get(key) and tonight.run.get(key):
            made.append(_other(f"The {key}", str(baseline.run[key]), str(tonight.run[key])))
    if changed := redefined(baseline.run, tonight.run):
        made.append(f"The definition changed of {', '.join(changed)}: their places were compared unpaired.")
    if unmatched:
        made.append(
            f"Seeds, or the rows, of {unmatched} places are not those of the baseline: these places were compared "
            "unpaired."
        )
    if short:
        made.append(f"At {short} places highlights of the baseline are missing tonight, in frames of the same seeds.")
    if not bit_equal:
        made += _numbers(baseline, tonight, limits)
    return tuple(note for note in made if note)


def _differing(before: dict[str, Any], after: dict[str, Any]) -> tuple[str, str]:
    first, second = (dict(run.get("versions") or {}) for run in (before, after))
    names = [name for name in sorted(first.keys() | second.keys()) if first.get(name) != second.get(name)]
    return tuple(", ".join(f"{name} {own.get(name, 'missing')}" for name in names) for own in (first, second))  # type: ignore[return-value]


def _other(what: str, before: str | None, after: str | None) -> str:
    if before == after:
        return ""
    more = _FOLLOWS.get(what, "")
    return f"{what} changed from {before or 'unknown'} to {after or 'unknown'}. {more}".strip()


def _numbers(baseline: Night, tonight: Night, limits: Limits) -> list[str]:
    """Say how near the medians are, and how many answers changed in kind."""
    first, second = (
        night.rows.filter(ANSWERED).group_by(PLACE).agg(pl.col("error_deg").median()) for night in (baseline, tonight)
    )
    both = first.join(second, on=PLACE, suffix="_2")
    apart = (both["error_deg"] - both["error_deg_2"]).abs()
    made = []
    if both.height:
        made.append(
            f"Medians agree to {limits.medians_deg:g} deg at {int((apart <= limits.medians_deg).sum())} of "
            f"{both.height} places; they differ by {float(apart.to_numpy().max()):.2g} deg at most."
        )
    found = changes(baseline.rows, tonight.rows)
    if found.pairs:
        made.append(
            f"Of {found.pairs} pairs of answers {found.status} differ in status, {found.lost} of them answered in the "
            f"baseline alone and {found.gained} tonight alone; of {found.frames} frames {found.detections} have "
            "another number of detections: contours that changed topology."
        )
    return made
