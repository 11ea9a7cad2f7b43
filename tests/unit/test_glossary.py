"""The glossary names everything that the manual's concepts define and that results are made of."""

import re
import tomllib
from pathlib import Path

import pytest

from simtest.detection.detector import Kind
from simtest.estimators.budget import PARTS

ROOT = Path(__file__).parents[2]
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
