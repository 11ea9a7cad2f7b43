"""What went wrong inside estimators and cores during a run: exceptions and broken answers, with their text.

A refusal is an answer of a method; a fault is a mistake in its code, or the end of its process. Results count both as
failures. Faults are told apart here, so that nobody takes a bug for a refusal.
"""

from collections.abc import Iterable

import polars as pl

from simtest.errors import FAULTS
from simtest.runtime.files import JsonObject

MOST_TEXTS = 5
"""Different texts of one estimator that are listed; a number within the text may make every one of them new."""

MOST_CHARACTERS = 300
"""Of a text that is listed."""


def faults_of(results: pl.DataFrame) -> list[JsonObject]:
    """List the faults of a run by estimator, reason and text.

    Parameters
    ----------
    results : polars.DataFrame
        Rows of results.parquet.

    Returns
    -------
    list of dict
        Of each distinct text ``estimator``, ``reason``, ``text`` and ``count``, the number of its rows; the most
        frequent first for each estimator. Beyond `MOST_TEXTS` the rest of an estimator's texts is one entry, without a
        reason.
    """
    if not {"estimator", "status"} <= set(results.columns):
        return []
    text = pl.col("flags").cast(pl.String) if "flags" in results.columns else pl.lit(None, pl.String)
    found = results.filter(pl.col("status").is_in(list(map(str, FAULTS)))).with_columns(_one_line(text).alias("_text"))
    counts = found.group_by("estimator", "status", "_text", maintain_order=True).len()
    listed: list[JsonObject] = []
    for (name,), own in counts.group_by("estimator", maintain_order=True):
        ranked = list(own.sort("len", descending=True, maintain_order=True).iter_rows())
        for _, reason, told, count in ranked[:MOST_TEXTS]:
            listed.append({"estimator": name, "reason": reason, "text": told, "count": count})
        if rest := ranked[MOST_TEXTS:]:
            told = f"{len(rest)} other texts; column flags of results.parquet holds them"
            listed.append({"estimator": name, "reason": "", "text": told, "count": sum(each[3] for each in rest)})
    return listed


def _one_line(text: pl.Expr) -> pl.Expr:
    return text.fill_null("").str.replace_all(r"\s+", " ").str.strip_chars().str.slice(0, MOST_CHARACTERS)


def fault_sentence(estimator: str, reason: str, text: str, count: int) -> str:
    """Return an entry of `faults_of` in words: ``moment: ValueError: my bug (my_core.py:11), 29 times``.

    An exception of the estimator names itself; the other reasons stand before their text.
    """
    named = "" if reason in ("", "estimator_error") else reason
    told = ": ".join(part for part in (estimator, named, text or reason) if part)
    return f"{told}, {'once' if count == 1 else f'{count} times'}"


def fault_sentences(faults: Iterable[dict[str, object]]) -> list[str]:
    """Return the faults of summary.json in words."""
    return [
        fault_sentence(str(each["estimator"]), str(each["reason"]), str(each["text"]), int(str(each["count"])))
        for each in faults
    ]
