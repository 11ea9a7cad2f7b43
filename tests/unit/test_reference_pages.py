"""The reference pages and the glossary name all that the code has: estimators, flags, columns, keys, limits, terms."""

import ast
import re
import tomllib
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from simtest.detection.detector import Kind
from simtest.errors import Reason
from simtest.estimators.budget import PARTS, STATED
from simtest.estimators.protocol import Estimate
from simtest.estimators.small_spots import UNRESOLVED
from simtest.reconstruction.explanations import FLAGS
from simtest.runtime.files import DEFAULTS
from simtest.validation.columns import SCHEMA
from simtest.validation.statistics import Figures
from studies.manual.files_page import files_page

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs/reference"
FLAGGING = ("estimators", "inverse", "reconstruction")
"""Packages whose code sets flags."""


def page(name):
    return (PAGES / name).read_text(encoding="utf-8")


def missing(names, text):
    """Return the names that do not stand in the text as code."""
    return sorted(name for name in names if not re.search(rf"`[^`\n]*\b{re.escape(name)}\b[^`\n]*`", text))


def flags_in(tree):
    """Yield the words of a module that become flags: in `flags`, or as keys of `conditions` or `masks`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "append":
            values = node.args if getattr(node.func.value, "id", "") == "flags" else []
        elif isinstance(node, ast.Assign):
            named = [getattr(getattr(each, "value", each), "id", "") for each in node.targets]
            held = [node.value, *(each.slice for each in node.targets if isinstance(each, ast.Subscript))]
            values = held if {"flags", "conditions", "masks"} & set(named) else []
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            values = [node.value] if getattr(node.target, "id", "") in ("flags", "conditions", "masks") else []
        elif isinstance(node, ast.keyword) and node.arg == "flags":
            values = [node.value]
        else:
            continue
        for each in (found for value in values for found in ast.walk(value)):
            if isinstance(each, ast.Constant) and isinstance(each.value, str) and re.fullmatch("[a-z_]+", each.value):
                yield each.value


@cache
def flags():
    sources = (file for package in FLAGGING for file in (ROOT / "simtest" / package).glob("*.py"))
    found = {flag for file in sources for flag in flags_in(ast.parse(file.read_text(encoding="utf-8")))}
    return found - {"flags"} | {UNRESOLVED}  # the former is a key of normals.json


def test_flags_are_found_in_the_code():
    assert {"missing_isovalues", "misfit", "cut", "clouds_refused", "round", "vignetted", "dim", "small"} <= flags()


def test_every_flag_is_explained():
    section = page("estimators.md").partition("\n### Flags\n")[2].partition("\n### ")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == flags() == set(FLAGS)


def test_every_reason_is_explained():
    section = page("estimators.md").partition("\n### Reasons for a refusal\n")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(Reason)


def test_every_estimator_has_a_section():
    own = [point.name for point in entry_points(group="simtest.estimators") if point.value.startswith("simtest.")]
    assert not [name for name in own if f"\n### {name}\n" not in page("estimators.md")]


def test_every_part_of_a_budget_is_explained():
    section = page("estimators.md").partition("\n## Uncertainty\n")[2].partition("\n## ")[0]
    assert not missing((*PARTS, STATED), section)


def test_every_field_of_an_estimate_is_explained():
    section = page("estimators.md").partition("### What an estimator returns")[2]
    assert not missing(Estimate.__dataclass_fields__, section)


@pytest.mark.parametrize("names", [SCHEMA, Figures.model_fields], ids=["columns", "figures"])
def test_every_column_and_figure_is_explained(names):
    assert not missing(names, files_page())


def test_every_limit_is_listed_with_its_number():
    section = page("limits.md").partition("\n## Limits\n")[2].partition("\n## ")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", section, re.MULTILINE))
    assert set(rows) == set(DEFAULTS)
    scales = {"MB": 1e6, "GB": 1e9, "million": 1e6}
    for name, written in rows.items():
        number, _, unit = written.replace(",", "").replace(" x 10^", "e").partition(" ")
        assert float(number) * scales.get(unit, 1) == DEFAULTS[name]


CONCEPTS = ROOT / "docs/concepts"
GLOSSARY = (CONCEPTS / "glossary.md").read_text(encoding="utf-8").lower()


def defined_terms(page: str) -> list[str]:
    """Return the terms that a page defines: bold words inside a sentence, which begin small or with a name."""
    bold = re.findall(r"\*\*((?:[a-z]|Cramer)[^*]*)\*\*", (CONCEPTS / page).read_text(encoding="utf-8"))
    return [" ".join(text.lower().split()) for text in bold]


@pytest.mark.parametrize("page", ["theory.md", "uncertainty.md"])
def test_every_term_that_a_page_defines_stands_in_the_glossary(page: str) -> None:
    terms = defined_terms(page)
    assert terms
    # Plurals are found by their singular.
    assert [term for term in terms if term.rstrip("s") not in GLOSSARY] == []


def test_the_glossary_has_all_budget_parts_estimators_and_where_kinds_are_listed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = [*PARTS, *project["entry-points"]["simtest.estimators"]]
    assert [name for name in names if f"`{name}`" not in GLOSSARY] == []
    detection = (CONCEPTS / "detection.md").read_text(encoding="utf-8")
    assert [kind.value for kind in Kind if f"\n| {kind.value} " not in detection] == []


def test_every_term_of_the_glossary_stands_once() -> None:
    terms = [line.split("|")[1].strip() for line in GLOSSARY.splitlines() if line.startswith("| ")]
    terms = [term for term in terms if term not in ("term", "---")]
    assert len(terms) > 80
    assert sorted(set(terms)) == sorted(terms)
