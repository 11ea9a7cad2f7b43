"""The verdict as JUnit XML: a suite an experiment, a test case a place, and the canaries and costs as suites."""

import re
from collections.abc import Iterable
from xml.etree import ElementTree as ET

import polars as pl

from simtest.nightly.gate.records import PLACE, Night, Verdict
from simtest.nightly.overview import number, place_name, without_canaries

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 has no way to write."""

Case = tuple[str, str, str | None, str | None]
"""Class, name, why it failed, why it was skipped."""


def junit(night: Night, verdict: Verdict) -> str:
    """Give the report as XML text.

    A place fails where one of its figures is worse, and is skipped where there is nothing to compare it with.
    """
    run = night.run
    suites = {
        f"{run['profile']}.{experiment}": list(cases) for experiment, cases in _places(night, verdict)
    }  # fmt: skip
    suites[f"{run['profile']}.canaries"] = list(_canaries(night))
    root = ET.Element("testsuites", name=f"simtest nightly {run['profile']}", time=f"{run['duration_s']:.1f}")
    for name, cases in suites.items():
        if cases:
            root.append(_suite(name, cases, run["started"]))
    # The schema has no count of skipped cases here.
    for count in ("tests", "failures", "errors"):
        root.set(count, str(sum(int(suite.get(count, "0")) for suite in root)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _suite(name: str, cases: list[Case], started: str) -> ET.Element:
    failures, skipped = (sum(case[place] is not None for case in cases) for place in (2, 3))
    suite = ET.Element(
        "testsuite", name=_text(name), tests=str(len(cases)), failures=str(failures), errors="0", skipped=str(skipped),
        time="0", timestamp=started[:19],
    )  # fmt: skip
    for class_name, title, failure, skip in cases:
        case = ET.SubElement(suite, "testcase", classname=_text(class_name), name=_text(title), time="0")
        if failure is not None:
            told = ET.SubElement(case, "failure", message=_text(failure.splitlines()[0]), type="regression")
            told.text = _text(failure)
        elif skip is not None:
            ET.SubElement(case, "skipped", message=_text(skip))
    return suite


def _places(night: Night, verdict: Verdict) -> Iterable[tuple[str, Iterable[Case]]]:
    """Give the cases of each experiment, and of the costs."""
    measured = night.figures.filter(pl.col("kind") != "canary").select(*PLACE).unique(maintain_order=True)
    compared = {
        tuple(place): group
        for place, group in without_canaries(night, verdict).group_by(*PLACE, maintain_order=True)
    }  # fmt: skip
    rows = {tuple(row[name] for name in PLACE): row for row in measured.iter_rows(named=True)}
    rows |= {place: dict(zip(PLACE, place, strict=True)) for place in compared if place not in rows}
    by_experiment: dict[str, list[Case]] = {}
    for place, row in rows.items():
        experiment = str(row["experiment"])
        class_name = f"{night.run['profile']}.{experiment}"
        title = place_name(row) or experiment
        failure, skip = _judged(compared.get(place))
        by_experiment.setdefault(experiment, []).append((class_name, title, failure, skip))
    return by_experiment.items()


def _judged(comparisons: pl.DataFrame | None) -> tuple[str | None, str | None]:
    """Give why a place failed, or why it was skipped."""
    if comparisons is None:
        return None, "nothing to compare with"
    worse = comparisons.filter(pl.col("outcome") == "worse")
    if worse.height:
        return "\n".join(_worse(row) for row in worse.iter_rows(named=True)), None
    if comparisons["outcome"].is_in(["new", "gone"]).all():
        return None, f"the place is {comparisons['outcome'][0]}"
    return None, None


def _worse(row: dict[str, object]) -> str:
    unit = str(row["unit"] or "")
    tonight, baseline, margin, p = (_number(row[key], unit) for key in ("tonight", "baseline", "margin", "p_holm"))
    return f"{row['quantity']}: {tonight}, baseline {baseline}, margin {margin}, p {p.removesuffix(f' {unit}')} (Holm)"


def _number(value: object, unit: str) -> str:
    return number(value if isinstance(value, float) else None, unit)


def _canaries(night: Night) -> Iterable[Case]:
    for row in night.figures.filter(pl.col("kind") == "canary").iter_rows(named=True):
        allowed = f"must be {number(row['low'], row['unit'])} to {number(row['high'], row['unit'])}"
        told = f"{row['quantity']} = {number(row['value'], row['unit'])}: {allowed}"
        words = (row["experiment"], row["setting"], row["estimator"], row["quantity"])
        title = ", ".join(str(word) for word in words if word)
        yield f"{night.run['profile']}.canaries", title, None if row["passed"] else told, None


def _text(value: str) -> str:
    return _NOT_XML.sub("\ufffd", value)
