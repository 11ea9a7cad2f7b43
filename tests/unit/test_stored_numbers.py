"""Numbers that outlast a process: the seed tree, files of arrays, and what was fitted to data."""

import ast
import math
import re
import shutil
import tomllib
import zipfile

import numpy as np
import pytest

from simtest.runtime import arrays, provenance
from simtest.runtime.arrays import write_arrays
from simtest.runtime.fitted import FILE, fitted_number
from simtest.runtime.seeds import Stage, from_integer, generator, integer, key
from simtest.spec.recipes import Distribution


def test_the_seed_tree_is_that_of_every_release():
    place = (7, "overview", "plane", 3, Stage.SENSOR)
    assert key("overview") == 11416273768129411606
    assert integer(*place) == 2421970951038761668
    assert generator(*place).integers(2**63, size=2).tolist() == [3954648001182531059, 2709375692794661143]
    assert from_integer(5).integers(2**63) == 6307306053231797772
    assert [stage.value for stage in Stage] == [0, 1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("form", "values"),
    [
        ({"low": 1, "high": 2}, [1.2515898007485415, 1.7324999133472123, 1.0566206926376902]),
        ({"low": 1, "high": 100, "log": True}, [3.185514611703684, 29.17425849799716, 1.297900456774583]),
        ({"low": 1, "high": 6, "integer": True}, [2, 2, 1]),
        ({"low": 1, "high": 1000, "integer": True, "log": True}, [5, 157, 1]),
        ({"choose": ("a", "b", "c"), "weights": (1, 2, 1)}, ["b", "b", "a"]),
    ],
)
def test_a_recipe_draws_what_every_release_draws(form, values):
    rng = from_integer(11)
    assert [Distribution(**form).draw(rng) for _ in range(3)] == values


def some_arrays():
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((300, 400)).astype(np.float32)
    return {
        "noise": noise,
        "zeros": np.zeros((300, 400, 3), dtype=np.float32),
        "half": np.where(np.arange(400) < 240, np.float32(np.nan), noise),
        "mask": noise > 0.5,
        "turned": np.asfortranarray(noise),
        "empty": np.zeros((0, 3)),
        "one": np.array(2.5),
    }


def test_numpy_reads_back_what_was_written(tmp_path):
    write_arrays(tmp_path / "a.npz", some_arrays())
    with np.load(tmp_path / "a.npz", allow_pickle=False) as read:
        assert read.files == list(some_arrays())
        for name, array in some_arrays().items():
            assert read[name].dtype == array.dtype
            np.testing.assert_array_equal(read[name], array)


def test_the_same_arrays_give_the_same_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        write_arrays(tmp_path / name, some_arrays())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_only_what_shrinks_is_compressed(tmp_path):
    write_arrays(tmp_path / "a.npz", some_arrays())
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        kinds = {entry.filename: entry.compress_type for entry in file.infolist()}
        sizes = {entry.filename: entry.compress_size / entry.file_size for entry in file.infolist()}
    assert kinds["noise.npy"] == zipfile.ZIP_STORED
    for name in ("zeros.npy", "half.npy", "mask.npy"):
        assert kinds[name] == zipfile.ZIP_DEFLATED
    assert sizes["zeros.npy"] < 0.01
    assert sizes["half.npy"] < 0.6


def test_objects_are_refused(tmp_path):
    with pytest.raises(ValueError, match="Object arrays"):
        write_arrays(tmp_path / "a.npz", {"objects": np.array([{}], dtype=object)})


PACKAGE = FILE.parent
SAYS_FITTED = re.compile(
    r"\b(fitted|calibrated|tuned) (to|on|over|by|with)\b|\b(was|were) (fitted|calibrated|tuned)\b", re.IGNORECASE
)
EXCEPTIONS = {
    "conventions.SPECULAR_MIN_AREA_PX": "says from how many pixels an ellipse is fitted to a highlight",
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
