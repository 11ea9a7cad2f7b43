"""The gate: tonight against the baseline."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import polars as pl

from simtest.nightly.gate import expectations as known
from simtest.nightly.gate import missing_results as missing
from simtest.nightly.gate.contrasts import Outcomes, paired, unpaired
from simtest.nightly.gate.holm import holm
from simtest.nightly.gate.limits import Limits
from simtest.nightly.gate.notes import large_and_undecided, notes_on, redefined
from simtest.nightly.gate.pairing import Numbered, alone, pairing, pairs
from simtest.nightly.gate.pairing_units import paired_sums, sums
from simtest.nightly.gate.pooling import pooled
from simtest.nightly.gate.quantities import WHERE_MIXED, Quantity, quantities
from simtest.nightly.gate.records import COMPARISONS, PLACE, POOLED, Night, Verdict

DEFAULTS = Limits()
PENALISED = "mean_penalised_deg"


def compare(tonight: Night, baseline: Night | None, limits: Limits = DEFAULTS) -> Verdict:
    """Hold a night against the baseline.

    Places whose results are the same bytes are the same; the others are tested, pair by pair where seeds and versions
    are the same, with all tests as one family (docs/gate.md).

    Parameters
    ----------
    tonight : Night
        The night.
    baseline : Night or None
        What it is held against; None where there is none: canaries are judged all the same.
    limits : Limits
        Level and margins.

    Returns
    -------
    Verdict
        "regression" where a comparison is worse, else "no baseline" or "fine". What tonight lacks (a place, true
        highlights of a place whose seeds are the same, a canary) is worse.
    """
    before = None if baseline is None else baseline.figures
    same_machine = baseline is None or baseline.run.get("processor") == tonight.run.get("processor")
    made = known.canaries(tonight.figures, before) + known.costs(tonight.figures, before, limits, same_machine)
    bit_equal: bool | None = None
    notes: tuple[str, ...] = ("There is no baseline: nothing but the canaries was judged.",)
    if baseline is not None:
        first, second = missing.digests(baseline.figures), missing.digests(tonight.figures)
        bit_equal = first.select(*PLACE, "digest").equals(second.select(*PLACE, "digest"))
        shared = first.join(second, on=PLACE, suffix="_2", maintain_order="left")
        differing = shared.filter(pl.col("digest") != pl.col("digest_2")).select(*PLACE)
        made += missing.places(first, second) + _same(shared, tonight.figures, limits)
        tested, unmatched, short = _tested(baseline, tonight, differing, limits)
        made += tested
        notes = notes_on(baseline, tonight, bit_equal, unmatched, short, limits)
    comparisons = pl.DataFrame(made, schema=COMPARISONS)
    state = "fine" if baseline is not None else "no baseline"
    if (comparisons["outcome"] == "worse").any():
        state = "regression"
    notes += large_and_undecided(comparisons)
    return Verdict(state, bit_equal, comparisons, notes, None if baseline is None else baseline.run)


def _same(shared: pl.DataFrame, figures: pl.DataFrame, limits: Limits) -> list[dict[str, Any]]:
    """Give the comparisons of places whose results are the same bytes."""
    equal = shared.filter(pl.col("digest") == pl.col("digest_2")).select(*PLACE)
    wanted = quantities(limits)
    values = figures.filter((pl.col("kind") == "setting") & pl.col("quantity").is_in(list(wanted)))
    made = []
    for row in equal.join(values, on=PLACE, maintain_order="left_right").to_dicts():
        own = {name: row[name] for name in (*PLACE, "quantity", "n")}
        quantity = wanted[row["quantity"]]
        margin = max(quantity.relative * row["value"], quantity.absolute)
        same = {"unit": quantity.unit, "method": "equal", "baseline": row["value"], "tonight": row["value"]}
        made.append({**own, **same, "difference": 0.0, "low": 0.0, "high": 0.0, "margin": margin, "outcome": "same"})
    return made


def _tested(
    baseline: Night, tonight: Night, differing: pl.DataFrame, limits: Limits
) -> tuple[list[dict[str, Any]], int, int]:
    """Give the comparisons of places whose results differ; how many are no pairs, and how many lost highlights."""
    if differing.is_empty():
        return [], 0, 0
    names = differing.with_row_index("place").with_columns(pl.col("place").cast(pl.Int64))
    before, after = (Numbered.of(night.rows, names) for night in (baseline, tonight))
    matched = pairing(before, after)
    moved = redefined(baseline.run, tonight.run)
    comparable = frozenset(names.filter(~pl.col("experiment").is_in(moved))["place"].to_list())
    if known_versions(baseline.run) != known_versions(tonight.run):
        comparable = frozenset()
    found = matched.places & comparable
    every, named = quantities(limits), names.select(PLACE).to_dicts()
    made = missing.highlights(matched.lost, named, comparable)
    # Where all answered, the penalised mean is the mean: it would be tested twice.
    once = (pl.col("quantity") != PENALISED) | pl.col("place").is_in(_with_unanswered(before, after))
    for name in WHERE_MIXED:
        once &= (pl.col("quantity") != name) | pl.col("place").is_in(_mixed(name, before, after))
    sums_of_pairs = paired_sums(pairs(before, after, found).filter(once))
    singles = [sums(alone(night, found).filter(once)) for night in (before, after)]
    for name, quantity in every.items():
        own = sums_of_pairs.filter(pl.col("quantity") == name).sort("place")
        tables = [(own["place"].to_list(), paired(own, quantity), "paired")]
        shared, first, second = _matched(*(table.filter(pl.col("quantity") == name) for table in singles))
        tables.append((shared, unpaired(first, second, quantity), "unpaired"))
        for places, outcomes, method in tables:
            rows = [named[place] for place in places]
            made += _as_rows(rows, name, quantity, outcomes, method)
            made += _pooled_rows(rows, name, quantity, outcomes, method)
        if name != PENALISED and name not in WHERE_MIXED:
            made += _unanswerable(named, name, quantity, (before, after), {*own["place"], *shared})
    return _judged(made, limits), names.height - len(matched.places), matched.lost.height


def _with_unanswered(*nights: Numbered) -> list[int]:
    """Give the places where a highlight went unanswered in one of the nights."""
    return sorted({place for night in nights for place in night.rows.filter(pl.col("unanswered") > 0)["place"]})


def _mixed(name: str, *nights: Numbered) -> list[int]:
    """Give the places where what a quantity counts is so of some answers and not of others, of both nights together."""
    both = pl.concat([night.rows.select("place", name) for night in nights]).drop_nulls()
    found = both.group_by("place").agg(pl.col(name).n_unique().alias("kinds")).filter(pl.col("kinds") > 1)
    return sorted(found["place"].to_list())


def known_versions(run: Mapping[str, Any]) -> dict[str, str]:
    """Give the versions of the packages that numbers depend on; simtest's own is what the gate is there for."""
    return {name: version for name, version in dict(run.get("versions") or {}).items() if name != "simtest"}


def _matched(first: pl.DataFrame, second: pl.DataFrame) -> tuple[list[int], pl.DataFrame, pl.DataFrame]:
    """Give the places that both tables hold, and the tables of these, in order."""
    shared = sorted(set(first["place"].to_list()) & set(second["place"].to_list()))
    kept = [table.filter(pl.col("place").is_in(shared)).sort("place") for table in (first, second)]
    return shared, kept[0], kept[1]


def _as_rows(
    places: list[dict[str, Any]], name: str, quantity: Quantity, found: Outcomes, method: str, unit: str | None = None
) -> list[dict[str, Any]]:
    """Give outcomes as rows, still without corrected p-values; `better` is the p-value of the mirror image."""
    sign, start = (-1.0, 1.0) if quantity.falls else (1.0, 0.0)
    columns = {
        "n": found.n, "baseline": start + sign * found.baseline, "tonight": start + sign * found.tonight,
        "difference": sign * found.difference, "low": sign * (found.high if quantity.falls else found.low),
        "high": sign * (found.low if quantity.falls else found.high), "margin": found.margin, "p": found.worse,
        "better": found.better, "within": found.within,
    }  # fmt: skip
    lists = {key: values.tolist() for key, values in columns.items()}
    shared = {"quantity": name, "unit": quantity.unit if unit is None else unit, "method": method}
    return [
        {**place, **shared, **{key: _plain(values[i]) for key, values in lists.items()}}
        for i, place in enumerate(places)
    ]


def _plain(value: Any) -> Any:
    """Give a number, or None where it is none."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _pooled_rows(
    places: list[dict[str, Any]], name: str, quantity: Quantity, found: Outcomes, method: str
) -> list[dict[str, Any]]:
    """Give the tests over all places of an estimator, in each experiment and in all together."""
    made = []
    everywhere = dict.fromkeys(("label", "surface", "setting"), POOLED)
    groups: dict[tuple[str, str], list[int]] = {}
    for i, place in enumerate(places):
        for experiment in (place["experiment"], POOLED):
            groups.setdefault((experiment, place["estimator"]), []).append(i)
    for (experiment, estimator), members in groups.items():
        several = len({places[i]["experiment"] for i in members}) > 1
        if len(members) < 2 or (experiment == POOLED and not several):
            continue
        own = Outcomes(**{key: values[members] for key, values in vars(found).items()})
        row = {"experiment": experiment, **everywhere, "estimator": estimator}
        made += _as_rows([row], name, quantity, pooled(own, quantity), method, "x" if quantity.relative else None)
    return made


def _unanswerable(
    named: list[dict[str, Any]], name: str, quantity: Quantity, nights: Iterable[Numbered], tested: set[int]
) -> list[dict[str, Any]]:  # fmt: skip
    """Give the places where a quantity is known in one night alone, or in both but of no pair."""
    table = "frames" if name == "false" else "rows"
    here, there = (
        {place: value for place, value in _means(getattr(night, table), name) if place not in tested}
        for night in nights
    )
    made = []
    for place in sorted(here.keys() | there.keys()):
        before, after = here.get(place), there.get(place)
        outcome = "new" if before is None else "gone" if after is None else "undecided"
        if quantity.falls:
            before, after = (None if value is None else 1 - value for value in (before, after))
        values = {"baseline": before, "tonight": after, "unit": quantity.unit, "method": "none"}
        made.append({**named[place], "quantity": name, **values, "settled": outcome})
    return made


def _means(table: pl.DataFrame, name: str) -> list[tuple[int, float]]:
    known_rows = table.filter(pl.col(name).is_not_null())
    return list(known_rows.group_by("place").agg(pl.col(name).mean()).iter_rows())


def _judged(made: list[dict[str, Any]], limits: Limits) -> list[dict[str, Any]]:
    """Correct the p-values of one family, and settle the outcomes."""
    family = [row for row in made if row.get("p") is not None]
    if family:
        shares = _weights([row["setting"] == POOLED for row in family], limits.pooled_weight)
        worse, better = (holm([row[key] for row in family], shares) for key in ("p", "better"))
        for row, p, mirrored in zip(family, worse.tolist(), better.tolist(), strict=True):
            row |= {"p_holm": p, "outcome": _outcome(row, p, mirrored, limits)}
    for row in made:
        row.setdefault("outcome", row.get("settled") or ("equivalent" if row.get("within") else "undecided"))
    return [{name: row.get(name) for name in COMPARISONS} for row in made]


def _weights(is_pooled: list[bool], share: float) -> np.ndarray:
    """Give each test its weight in the family: the pooled ones have a share of it together, where there are both."""
    flags = np.array(is_pooled)
    if flags.all() or not flags.any():
        return np.ones(len(flags))
    return np.where(flags, share / flags.sum(), (1 - share) / (~flags).sum())


def _outcome(row: dict[str, Any], worse: float, better: float, limits: Limits) -> str:
    if worse <= limits.alpha:
        return "worse"
    if better <= limits.alpha:
        return "better"
    low, high, margin = row["low"], row["high"], row["margin"]
    inside = low is not None and high is not None and -margin <= low and high <= margin
    return "equivalent" if inside or row["within"] else "undecided"
