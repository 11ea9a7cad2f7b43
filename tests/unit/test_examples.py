"""Each example runs as a user runs it, and makes the picture that the list of examples shows."""

import json
import os
import re
import runpy
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.*"))
NOTEBOOKS = [each for each in EXAMPLES if each.suffix == ".ipynb"]
SCRIPTS = [each for each in EXAMPLES if each.suffix == ".py"]
MANUAL = ROOT / "docs" / "images" / "examples"
LONGEST, LONGEST_TRAINING = 60, 160
LARGEST_KB = 150

LEARN = ("torch",)
"""Package of the extra that the example of a training needs."""

pytestmark = pytest.mark.skipif(not EXAMPLES, reason="the checkout's examples folder is not there")


def cases(in_process):
    """Yield the examples; trainings run where their packages are, in tests that take longer, and once."""
    for script in EXAMPLES:
        trains = "_train_" in script.name
        lacks = pytest.mark.skipif(not all(map(find_spec, LEARN)), reason=f"needs the extra learn: {', '.join(LEARN)}")
        marks = [pytest.mark.slow, *([pytest.mark.extra] if in_process else []), lacks] if trains else []
        if not (in_process or trains or script.name.startswith("02_")):
            marks = [pytest.mark.slow]
        elif not trains and not (in_process and script.name.startswith(("01_", "02_", "06_"))):
            # `make examples` runs all.
            marks = [pytest.mark.ci]
        yield pytest.param(script, marks=marks, id=script.stem)


def arguments(example, folder):
    """The command line of an example: a notebook is run by its runner, which takes it whole."""
    out = ["--out", str(folder / "made")]
    if example in NOTEBOOKS:
        return [str(example.with_name("run_notebook.py")), str(example), *out]
    return [str(example), "--quick", *out]


def in_a_process_of_its_own(script, folder):
    own = dict(os.environ) | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments(script, folder)]
    done = subprocess.run(command, cwd=folder, env=own, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def in_this_process(monkeypatch, capfd):
    """Run an example as Python runs a script, without starting Python and the renderer anew: that takes 2 s."""

    def run(script, folder):
        monkeypatch.syspath_prepend(str(script.parent))
        argv = arguments(script, folder)
        monkeypatch.setattr(sys, "argv", argv)
        with plt.rc_context():
            runpy.run_path(argv[0], run_name="__main__")
        return capfd.readouterr().out

    monkeypatch.delitem(sys.modules, "common", raising=False)
    yield run
    sys.modules.pop("common", None)


def check_picture(script, folder, output):
    made = [file for file in (folder / "made").iterdir() if file.stem == script.stem]
    assert len(made) == 1
    assert str(made[0]) in output
    pixels = np.asarray(Image.open(made[0]).convert("L"), float)
    assert min(pixels.shape) >= 300
    # A figure without its data is a white sheet with thin axes.
    assert (pixels < 250).mean() > 0.01
    assert pixels.std() > 10


@pytest.mark.render
@pytest.mark.parametrize("script", cases(in_process=True))
def test_an_example_makes_its_picture(script, tmp_path, monkeypatch, in_this_process):
    # Run from another folder, so that an example depends on nothing that happens to lie in the checkout.
    monkeypatch.chdir(tmp_path)
    check_picture(script, tmp_path, in_this_process(script, tmp_path))


@pytest.mark.render
@pytest.mark.parametrize("script", cases(in_process=False))
def test_an_example_runs_as_a_user_runs_it(script, tmp_path):
    check_picture(script, tmp_path, in_a_process_of_its_own(script, tmp_path))


def test_a_training_without_its_packages_ends_in_one_line(tmp_path):
    (script,) = (script for script in EXAMPLES if "_train_" in script.name)
    # A module that cannot be found stands for a package that is not installed.
    hide = "import importlib.util as u, runpy, sys; u.find_spec = lambda name: None; sys.argv = sys.argv[1:]; "
    hide += f"sys.path.insert(0, {str(script.parent)!r}); runpy.run_path(sys.argv[0], run_name='__main__')"
    own = dict(os.environ) | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", hide, str(script), "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=own, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert done.stderr.startswith("missing: torch; pip install")
    assert len(done.stderr.splitlines()) == 1


def test_examples_are_short_numbered_and_listed():
    listed = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    assert [script.name[:2] for script in EXAMPLES] == [f"{n:02}" for n in range(1, len(EXAMPLES) + 1)]
    assert re.findall(r"\]\(([0-9][^)]*\.(?:py|ipynb))\)", listed) == [example.name for example in EXAMPLES]
    for script in SCRIPTS:
        text = script.read_text(encoding="utf-8")
        longest = LONGEST_TRAINING if "_train_" in script.name else LONGEST
        assert len(text.splitlines()) <= longest, script.name
        assert "\nPicture: " in text, script.name
        assert re.search(r"Takes\s+\d+ s\s+of\s+processor\s+time\.", text), script.name


def code_of(example):
    text = example.read_text(encoding="utf-8")
    if example in SCRIPTS:
        return text
    cells = json.loads(text)["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def test_examples_use_public_names_alone():
    for example in EXAMPLES:
        modules = set(re.findall(r"^\s*(?:from|import) (simtest[\w.]*)", code_of(example), re.MULTILINE))
        assert modules <= {"simtest", "simtest.dataset", "simtest.dataset.learn"}, example.name


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_notebooks_are_whole_and_without_outputs(notebook):
    held = json.loads(notebook.read_text(encoding="utf-8"))
    assert (held["nbformat"], held["nbformat_minor"]) == (4, 5)
    cells = held["cells"]
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        code = {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        assert set(cell) == {"cell_type", "id", "metadata", "source"} | code
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", "".join("".join(cell["source"]) for cell in cells)):
        assert (notebook.parent / target).exists(), target


def test_pictures_of_the_manual_are_small():
    listed = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    shown = re.findall(r"!\[[^]]*\]\(\.\./docs/images/examples/([^)]+)\)", listed)
    assert sorted(shown) == sorted(file.name for file in MANUAL.iterdir())
    assert [name[:2] for name in shown] == [script.name[:2] for script in EXAMPLES]
    for name in shown:
        assert (MANUAL / name).stat().st_size <= LARGEST_KB * 1000, name
