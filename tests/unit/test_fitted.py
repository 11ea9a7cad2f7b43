"""Numbers that were fitted to data: each has its unit and study, each is used, and both hashes cover them."""

import ast
import math
import re
import shutil
import tomllib

import pytest

from simtest.runtime import arrays, provenance
from simtest.runtime.fitted import FILE, fitted_number

PACKAGE = FILE.parent

SAYS_FITTED = re.compile(
    r"\b(fitted|calibrated|tuned) (to|on|over|by|with)\b|\b(was|were) (fitted|calibrated|tuned)\b", re.IGNORECASE
)

EXCEPTIONS = {
    "conventions.SPECULAR_MIN_AREA_PX": "says from how many pixels an ellipse is fitted to a highlight",
    "calibration.priors.UNTOLD_SLOPE_RAD": "is an assumption that spans the recipes' slopes; the recipe was fitted",
}
"""Module constants that say "fitted" and why they are no fitted numbers."""


def fits():
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


def names():
    return [f"{fit}.{name}" for fit, own in fits().items() for name in own if name != "study"]


def constants_that_say_fitted(path):
    """Yield the names of a module's constants beside which a string or a comment says that they were fitted."""
    source = path.read_text(encoding="utf-8")
    body, lines = ast.parse(source).body, source.splitlines()
    for number, node in enumerate(body):
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        first = node.lineno - 1
        while first and lines[first - 1].startswith("#"):
            first -= 1
        beside = [*lines[first : node.lineno - 1], lines[node.end_lineno - 1][node.end_col_offset :]]
        after = body[number + 1 : number + 2]
        if after and isinstance(after[0], ast.Expr) and isinstance(after[0].value, ast.Constant):
            beside += str(after[0].value.value).splitlines()
        if SAYS_FITTED.search(" ".join(beside)):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield from (each.id for each in ast.walk(target) if isinstance(each, ast.Name))


def test_every_number_has_its_unit_and_study():
    assert len(names()) >= 40
    for fit, own in fits().items():
        assert own["study"].strip(), fit
        for name, entry in own.items():
            if name != "study":
                assert set(entry) == {"value", "unit", "what"}, f"{fit}.{name}"
                assert math.isfinite(entry["value"]), f"{fit}.{name}"
                assert entry["unit"].strip(), f"{fit}.{name}"
                assert entry["what"].strip(), f"{fit}.{name}"


def test_every_study_that_is_named_is_there():
    named = re.findall(r"python -m (studies[\w.]+)", FILE.read_text(encoding="utf-8"))
    assert named
    root = PACKAGE.parent
    for study in named:
        path = root / study.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), study


def test_every_number_is_used_and_every_used_one_is_there():
    sources = [path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")]
    used = [name for source in sources for name in re.findall(r'fitted_number\("([\w.]+)"\)', source)]
    assert sorted(used) == sorted(names())
    for name in used:
        fit, number = name.split(".")
        assert fitted_number(name) == fits()[fit][number]["value"]


def test_no_module_constant_says_that_it_was_fitted():
    found = {
        ".".join((*path.relative_to(PACKAGE).with_suffix("").parts, name))
        for path in PACKAGE.rglob("*.py")
        for name in constants_that_say_fitted(path)
    }
    assert found == set(EXCEPTIONS)


@pytest.mark.parametrize(
    "source",
    ['A = 2.5\n"""Over the radius. Fitted\nto 217 highlights."""\n', "# Calibrated on seven frames.\nA = 2.5\n",
     "A: float = 2.5  # these were fitted\n"],
)  # fmt: skip
def test_a_fitted_constant_is_seen(source, tmp_path):
    path = tmp_path / "module.py"
    path.write_text(source, encoding="utf-8")
    assert list(constants_that_say_fitted(path)) == ["A"]


def test_a_missing_name_is_told_with_those_that_are_there():
    with pytest.raises(LookupError, match=r"^fitted\.toml: no 'bends\.men'; must be one of drift\.mean_share, .*bends"):
        fitted_number("bends.men")


@pytest.mark.parametrize(
    ("module", "hashed"), [(provenance, provenance.source_hash), (arrays, arrays._code)], ids=["results", "kept arrays"]
)
def test_a_changed_number_changes_the_hash(module, hashed, tmp_path, monkeypatch):
    root = tmp_path / "simtest"
    shutil.copytree(PACKAGE, root, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(module, "_ROOT", root)
    before = hashed.__wrapped__()
    assert hashed.__wrapped__() == before
    text = (root / FILE.name).read_text(encoding="utf-8")
    (root / FILE.name).write_text(text.replace("value = 5.5,", "value = 5.6,"), encoding="utf-8")
    assert hashed.__wrapped__() != before
