"""The verdict as JUnit XML: a suite an experiment, a test case a cell, the canaries as a suite of their own."""

import re
from collections.abc import Iterator
from typing import NamedTuple
from xml.etree import ElementTree as ET

import polars as pl

from simtest.nightly.phrases import cell_name, joined, plain
from simtest.nightly.records import CELL, JudgedRun, to_explain

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 has no way to write."""


class _Case(NamedTuple):
    """A test case, with the reasons why it failed or was skipped."""

    suite: str
    name: str
    failure: str | None
    skipped: str | None = None


def junit(judged: JudgedRun) -> str:
    """Return the report as XML text.

    A cell fails where one of its figures is worse or must be explained, and is skipped where there is nothing to
    compare it with.
    """
    record = judged.run.record
    # A suite an experiment, then the canaries
    suites: dict[str, list[_Case]] = {}
    for case in (*_cells(judged), *_canaries(judged)):
        suites.setdefault(f"{record.profile}.{case.suite}", []).append(case)
    root = ET.Element("testsuites", name=f"simtest nightly {record.profile}", time=f"{record.duration_s or 0:.1f}")
    root.extend(_suite(name, cases, record.started) for name, cases in suites.items())
    # The schema has no count of skipped cases here.
    for count in ("tests", "failures", "errors"):
        root.set(count, str(sum(int(suite.get(count, "0")) for suite in root)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _suite(name: str, cases: list[_Case], started: str) -> ET.Element:
    failures = sum(case.failure is not None for case in cases)
    skipped = sum(case.skipped is not None for case in cases)
    suite = ET.Element(
        "testsuite", name=_text(name), tests=str(len(cases)), failures=str(failures), errors="0", skipped=str(skipped),
        time="0", timestamp=started[:19],
    )  # fmt: skip
    for case in cases:
        element = ET.SubElement(suite, "testcase", classname=_text(name), name=_text(case.name), time="0")
        if case.failure is not None:
            first = _text(case.failure.splitlines()[0])
            ET.SubElement(element, "failure", message=first, type="regression").text = _text(case.failure)
        elif case.skipped is not None:
            ET.SubElement(element, "skipped", message=_text(case.skipped))
    return suite


def _cells(judged: JudgedRun) -> Iterator[_Case]:
    """Yield a case for each cell, costs included: those that were measured, then those of the baseline alone."""
    # Cells by name; those that the baseline alone has are among the compared ones only.
    measured = judged.run.figures.filter(pl.col("kind") != "canary").select(CELL)
    compared = dict(iter(judged.comparisons.group_by(CELL, maintain_order=True)))
    for cell in dict.fromkeys((*measured.iter_rows(), *compared)):
        row = dict(zip(CELL, cell, strict=True))
        yield _Case(row["experiment"], cell_name(row) or row["experiment"], *_judgement(compared.get(cell)))


def _judgement(comparisons: pl.DataFrame | None) -> tuple[str | None, str | None]:
    """Return why a cell failed, and why it was skipped."""
    if comparisons is None:
        return None, "nothing to compare with"
    findings = [
        f"{row['outcome']}: {row['quantity']}: {plain(row['tonight'], row['unit'])}, "
        f"baseline {plain(row['baseline'], row['unit'])}, "
        f"margin {plain(row['margin'], row['unit'])}, p {plain(row['p_holm'])} (Holm)"
        for row in comparisons.filter((pl.col("outcome") == "worse") | to_explain()).iter_rows(named=True)
    ]
    if findings:
        return "\n".join(findings), None
    if comparisons["outcome"].is_in(["new", "gone"]).all():
        return None, f"the cell is {comparisons['outcome'][0]}"
    return None, None


def _canaries(judged: JudgedRun) -> Iterator[_Case]:
    for row in judged.run.figures_of("canary").iter_rows(named=True):
        value, low, high = (plain(row[key], row["unit"]) for key in ("value", "low", "high"))
        name = joined(row["experiment"], row["setting"], row["estimator"], row["quantity"])
        yield _Case(
            "canaries", name, None if row["passed"] else f"{row['quantity']} = {value}: must be {low} to {high}"
        )


def _text(value: str) -> str:
    return _NOT_XML.sub("\ufffd", value)
