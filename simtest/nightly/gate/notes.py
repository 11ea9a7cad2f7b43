"""Notes of a verdict: in what two runs differ beside the comparisons."""

from collections.abc import Sequence

import polars as pl

from simtest.errors import Reason
from simtest.nightly.gate.limits import Limits
from simtest.nightly.gate.quantities import ANSWERED, IS_TRUE, KEY
from simtest.nightly.records import CELL, POOLED, NightlyRun, RunRecord

NO_CONTOUR = str(Reason.NO_CLOSED_ISOPHOTE)

_FAR, _FAR_DEG = 10, 1.0
"""A rise by so many margins and so many degrees is reported even where nothing can be decided."""


def redefined(baseline: RunRecord, tonight: RunRecord) -> list[str]:
    """Return the experiments whose definition is known in both records, and differs."""
    first, second = baseline.definitions, tonight.definitions
    return sorted(name for name in first.keys() & second.keys() if first[name] != second[name])


def large_and_undecided(comparisons: pl.DataFrame) -> tuple[str, ...]:
    """Report rises of single realisations that a reader must look at, though one number decides nothing."""
    errors = pl.col("quantity").is_in(["mean_deg", "mean_penalised_deg"]) & (pl.col("setting") != POOLED)
    far = (pl.col("difference") > _FAR * pl.col("margin")) & (pl.col("difference") > _FAR_DEG)
    found = comparisons.filter(errors & far, pl.col("n") == 1, pl.col("outcome") == "undecided")
    count = found.select(CELL).n_unique()
    if not count:
        return ()
    return (
        f"In {count} cells of one realisation the error rose by more than {_FAR} margins and {_FAR_DEG:g} deg, by "
        f"{float(found['difference'].to_numpy().max()):.2g} deg at most: too few to decide, look at them.",
    )


def notes_on(
    baseline: NightlyRun,
    tonight: NightlyRun,
    bit_equal: bool,
    unmatched: int,
    short: int,
    absent: Sequence[str],
    limits: Limits,
) -> tuple[str, ...]:
    """Report in what two runs differ beside their numbers, in plain sentences.

    `unmatched` counts the cells whose results differ and whose rows are no exact pairs, `short` those that have lost
    highlights of the baseline, `absent` names columns that the baseline lacks.
    """
    before, after = baseline.record, tonight.record
    first, second = before.versions, after.versions
    names = [name for name in sorted(first.keys() | second.keys()) if first.get(name) != second.get(name)]
    was, now = (", ".join(f"{name} {own.get(name, 'missing')}" for name in names) for own in (first, second))
    # simtest's own version is what the gate judges: its change alone leaves the pairs.
    unpaired = "" if set(names) <= {"simtest"} else "All cells were compared unpaired."
    made = [_changed("Versions", was, now, unpaired)]
    for key in ("processor", "profile", "variant", "llvm", "python"):
        # A record that lacks a key says nothing of it.
        if getattr(before, key) and getattr(after, key):
            made.append(_changed(f"The {key}", getattr(before, key), getattr(after, key)))
    made += _other_variants(before, after)
    if names := redefined(before, after):
        made.append(f"The definition of {', '.join(names)} changed: their cells were compared unpaired.")
    if unmatched:
        made.append(f"Seeds or rows of {unmatched} cells differ from the baseline's: these were compared unpaired.")
    if short:
        made.append(f"In {short} cells highlights of the baseline are missing tonight, in frames of the same seeds.")
    if absent:
        made.append(
            f"The baseline, of an older version, lacks {len(absent)} columns of results (such as {absent[0]}): what is "
            "made of them is judged from the next accepted baseline on."
        )
    if not bit_equal:
        made += _numbers(baseline, tonight, limits)
    return tuple(note for note in made if note)


def _other_variants(before: RunRecord, after: RunRecord) -> list[str]:
    """Report the experiments that both records name with another Mitsuba variant than the run's own."""
    shared = [name for name in sorted(before.variants) if name in after.variants]
    pairs = {name: (before.variants[name], after.variants[name]) for name in shared}
    # A change of the run's own variant is told once.
    pairs = {name: pair for name, pair in pairs.items() if pair != (before.variant, after.variant)}
    return [_changed(f"The variant of {name}", was, now) for name, (was, now) in pairs.items()]


def _changed(what: str, before: str | None, after: str | None, consequence: str = "") -> str:
    if before == after:
        return ""
    return f"{what} changed from {before or 'unknown'} to {after or 'unknown'}. {consequence}".strip()


def _numbers(baseline: NightlyRun, tonight: NightlyRun, limits: Limits) -> list[str]:
    """Report how near the medians are, and how many results changed in kind."""
    tables, made = (baseline.rows, tonight.rows), []
    # Medians by cell
    first, second = (rows.filter(ANSWERED).group_by(CELL).agg(pl.col("error_deg").median()) for rows in tables)
    both = first.join(second, on=CELL, suffix="_2")
    apart = (both["error_deg"] - both["error_deg_2"]).abs()
    if both.height:
        made.append(
            f"Medians agree to {limits.medians_deg:g} deg in {int((apart <= limits.medians_deg).sum())} of "
            f"{both.height} cells; they differ by {float(apart.to_numpy().max()):.2g} deg at most."
        )
    # Status by highlight: of the same seeds and definition, what changed is the code's.
    first, second = (
        rows.filter(IS_TRUE).select(*KEY, "status", answered=ANSWERED).unique(KEY, keep="first") for rows in tables
    )
    both = first.join(second, on=KEY, suffix="_2")
    before, after = pl.col("answered"), pl.col("answered_2")
    other = pl.col("status").ne_missing(pl.col("status_2"))
    # Only isophotes that open change a contour's topology; other reasons are named for what they are.
    opened = other & (before | after) & pl.any_horizontal(pl.col("status", "status_2") == NO_CONTOUR)
    counts = both.select(
        status=other, lost=before & ~after, gained=after & ~before, opened=opened,
        missed=pl.any_horizontal(pl.col("status", "status_2") == "missed") & other,
    ).sum()  # fmt: skip
    status, lost, gained, open_now, missed = counts.row(0)
    # Detections by frame
    frame = ("experiment", "setting", "realisation", "seed")
    first, second = (rows.group_by(frame).agg(found=pl.col("specularity").drop_nulls().n_unique()) for rows in tables)
    frames = first.join(second, on=frame, suffix="_2")
    detections = frames.filter(pl.col("found") != pl.col("found_2")).height
    if both.height:
        why = f" In {open_now} of them an isophote opened or closed." if open_now else ""
        why += f" In {missed} of them the highlight was detected in one run alone." if missed else ""
        made.append(
            f"Of {both.height} pairs of results {status} differ in status, {lost} of them answered in the baseline "
            f"alone and {gained} tonight alone; of {frames.height} frames {detections} have another number of "
            f"detections.{why}"
        )
    return made
