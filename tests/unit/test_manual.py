"""The manual: every page is reached, the reference is complete, links work, and the checks find faults."""

import inspect
import itertools
import json
import re
import tomllib
from xml.etree import ElementTree

import numpy as np
import pytest
from docstring_parser import parse
from markdown_links import anchors_of, dead_in_markdown

import simtest
from simtest.calibration import Calibration
from simtest.geometry import Camera
from simtest.reconstruction.options import Options
from simtest.reconstruction.outputs import constraints_arrays
from simtest.reconstruction.pipeline import reconstruct_values
from simtest.runtime.files import as_json
from simtest.simulation.frame_files import FILES
from simtest.validation.columns import COLUMNS
from simtest.validation.runner import RunRecord
from simtest.validation.statistics import Figures
from studies.manual import tables
from studies.manual.api_page import SECTIONS, api_page, entries
from studies.manual.blocks import ROOT, manual_pages
from studies.manual.commands_page import command, commands, commands_page, shipped_page
from studies.manual.diagrams import SHEETS, WIDTH, write_diagrams
from studies.manual.files_page import files_page
from studies.manual.keys_page import MODELS, keys_page
from studies.manual.links import dead_links
from studies.manual.pages import PAGES

DOCS = ROOT / "docs"
SITE = ROOT / "build/manual"


def written(tmp_path, text):
    """A page of the given text, as the blocks on it."""
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    return page


# Pages ---------------------------------------------------------------------------------------------------------------


def toctree_of(page):
    """The pages that a page's toctrees list."""
    text = page.read_text(encoding="utf-8")
    for tree in re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        for line in tree.splitlines():
            if line.strip() and not line.startswith(":"):
                yield (page.parent / line.strip()).resolve()


def test_every_page_stands_in_a_table_of_contents():
    generated = {(DOCS / name).with_suffix("") for name in PAGES}
    reached, waiting = set(), [DOCS / "index"]
    while waiting:
        page = waiting.pop()
        if page in reached:
            continue
        reached.add(page)
        file = page.with_suffix(".md")
        if file.exists():
            waiting += toctree_of(file)
        else:
            assert page in generated, f"a toctree lists {page.relative_to(DOCS)}, which is no page"
    pages = {page.with_suffix("") for page in manual_pages() if page.is_relative_to(DOCS)}
    assert len(pages) > 20
    assert sorted(page.relative_to(DOCS).as_posix() for page in pages - reached) == []


def test_installing_an_extra_keeps_the_editable_install_of_make_demo():
    files = [*manual_pages(), *(ROOT / "examples").glob("*.py"), ROOT / "Makefile"]
    of_checkout = r"pip install (?:[^`\n]* )?[\"']?\.(?:\[\w+\][\"']?)?(?=[\s`;)]|$)"
    found = {file: re.findall(of_checkout, file.read_text(encoding="utf-8"), re.MULTILINE) for file in files}
    assert sum(map(len, found.values())) > 8
    copies = [f"{file.relative_to(ROOT)}: {line}" for file in found for line in found[file] if " -e " not in line]
    assert copies == []


# Reference -----------------------------------------------------------------------------------------------------------


def test_every_public_name_is_in_the_reference():
    page = api_page()
    named = set(re.findall(r"^\.\. [\w:]+:: (\S+)$", page, re.MULTILINE))
    assert {f"simtest.{name}" for name in simtest.__all__} <= named
    things = list(entries().values())
    for package in SECTIONS:
        module = __import__(package, fromlist=["__all__"])
        missing = [name for name in module.__all__ if not any(getattr(module, name) is thing for thing in things)]
        assert missing == [], package
    for protocol in ("estimators.Estimator", "estimators.BatchEstimator", "estimators.FrameEstimator",
                     "detection.Detector", "calibration.Priors"):  # fmt: skip
        assert f"simtest.{protocol}" in named


def test_every_command_and_option_is_in_the_reference():
    page = commands_page()
    assert ["dataset", "verify"] in commands()
    for path in commands():
        assert re.search(rf"^#+ simtest {' '.join(path)}$", page, re.MULTILINE), path
        arguments = command(path).assemble_argument_collection() if command(path).default_command else ()
        for argument in arguments:
            for name in argument.names:
                if name.startswith("--"):
                    assert name in page, (path, name)


def test_names_of_what_is_shipped_are_in_the_reference():
    page = shipped_page()
    # Foolers are scenes of a study, taken by their path.
    files = [*ROOT.glob("scenes/*.toml"), *ROOT.glob("scenes/*/*.toml")]
    shipped = [path for path in files if path.parent.name != "foolers"]
    assert len(shipped) > 30
    points = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    estimators = points["simtest.estimators"]
    assert "cone_axis" in estimators
    presets = ("laparoscope", "colonoscope_2")
    names = {path.stem for path in shipped} | {*estimators, *presets}
    assert sorted(name for name in names if f"`{name}`" not in page) == []


def test_every_key_is_in_the_reference():
    page = keys_page()
    for kind, (_, model) in MODELS.items():
        assert f"## File: {kind}" in page
        schema = model.model_json_schema()
        for own in (schema, *schema.get("$defs", {}).values()):
            for key in own.get("properties", {}):
                assert f"| `{key}` |" in page, (kind, key)
    # Every table that a type names is there.
    linked = set(re.findall(r"\]\(#(\w+)\)", page))
    assert linked <= {name.lower() for name in re.findall(r"^### (\w+)$", page, re.MULTILINE)}
    assert "phongreflectance" in linked


def test_every_column_of_results_has_a_meaning():
    page = files_page()
    assert [name for name in COLUMNS if f"`{name}`" not in page] == []
    # An empty meaning is that of the column before, a component of the same vector or matrix.
    for before, name in itertools.pairwise(COLUMNS):
        assert COLUMNS[name].meaning or name[:3] == before[:3], name


def test_every_file_of_a_frame_is_in_the_reference():
    (listed,) = re.findall(r"^`simtest render` writes (.*)\.$", files_page(), re.MULTILINE)
    assert re.split(", | and ", listed) == list(FILES)
    assert "preview.jpg" in FILES


@pytest.mark.parametrize("record", [RunRecord, Figures])
def test_docstrings_of_records_name_their_fields(record):
    named = [name for own in parse(inspect.getdoc(record)).params for name in own.arg_name.split(", ")]
    fields = getattr(record, "model_fields", None) or record.__dataclass_fields__
    assert sorted(named) == sorted(fields)


def spot_picture():
    """A grey picture of one round highlight on a bright ground, 8 bits."""
    y, x = np.mgrid[:160, :200]
    return np.rint(60 + 180 * np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / (2 * 9.0**2))).astype(np.uint8)


def test_keys_of_normals_json_are_those_of_the_page():
    camera = Camera.from_fov(70.0, 200, 160)
    record = reconstruct_values("spot.png", spot_picture() / 255, Calibration(camera), Options(fov_deg=70.0))
    made = json.loads(json.dumps(record.to_json(), default=as_json))
    assert set(made) | {"reference"} == set(tables.NORMALS)
    (spot, *_) = made["specularities"]
    assert set(spot) <= set(tables.SPECULARITY)
    answered = [each for each in spot["estimates"].values() if each["status"] == "ok"]
    assert set().union(*answered) | {"detail"} == set(tables.ESTIMATE)
    arrays = constraints_arrays(record)
    assert set(arrays) == set(tables.CONSTRAINTS)
    count = len(arrays["id"])
    for name, (shape, _) in tables.CONSTRAINTS.items():
        assert str(arrays[name].shape) == shape.replace("N", str(count)), name


# Links and the built site --------------------------------------------------------------------------------------------


def test_dead_links_are_found(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "index.html").write_text(
        '<h1 id="top1">T</h1><a href="a/b.html#there">b</a><a href="#top1">t</a><a href="a/c.html">c</a>'
        '<a href="https://elsewhere.org">e</a><link rel="canonical" href="https://elsewhere.org">',
        encoding="utf-8",
    )
    (tmp_path / "a/b.html").write_text(
        '<p id="here"></p><a href="../index.html#none">i</a><img src="x.png">'
        '<script src="https://cdn.org/x.js"></script>',
        encoding="utf-8",
    )
    (tmp_path / "a/alone.html").write_text("<p></p>", encoding="utf-8")
    assert sorted(dead_links(tmp_path)) == [
        "a/alone.html: no page links here",
        "a/b.html: ../index.html#none: no such anchor",
        "a/b.html: loads https://cdn.org/x.js from elsewhere",
        "a/b.html: x.png: no such file",
        "index.html: a/b.html#there: no such anchor",
        "index.html: a/c.html: no such file",
    ]


def test_no_link_in_markdown_is_dead():
    made = {DOCS / name for name in PAGES}
    assert [dead for page in manual_pages() for dead in dead_in_markdown(page, made)] == []


def test_dead_links_in_markdown_are_found(tmp_path):
    (tmp_path / "other.md").write_text("# A title\n\n## 3. Your `own`, mesh\n\n## A title\n", encoding="utf-8")
    assert anchors_of((tmp_path / "other.md").read_text(encoding="utf-8")) == {
        "a-title",
        "3-your-own-mesh",
        "a-title-1",
    }
    page = written(
        tmp_path,
        "# P\n\n[a](other.md#3-your-own-mesh), [b](other.md#none), [c](gone.md), [d](#p), [e](#q), ![f](no.png),\n"
        "`[g](code.md)`, [h](https://elsewhere.org), [![i](gone.png)](other.md), [j](made.md)\n",
    )
    assert list(dead_in_markdown(page, {tmp_path / "made.md"})) == [
        "page.md: other.md#none: no such anchor",
        "page.md: gone.md: no such file",
        "page.md: #q: no such anchor",
        "page.md: no.png: no such file",
    ]


@pytest.mark.parametrize("name", SHEETS)
def test_a_diagram_is_small_and_its_text_stands_inside(name):
    text = (DOCS / f"images/{name}.svg").read_text(encoding="utf-8")
    assert len(text.encode()) < 60_000
    for line in ElementTree.fromstring(text).iter("{http://www.w3.org/2000/svg}text"):
        if line.get("transform") is None:
            # The letters of a wide font are half as wide as its size, on average over a line.
            width, x = 0.53 * float(line.get("font-size")) * len(line.text), float(line.get("x"))
            left = x - width * {"start": 0, "middle": 0.5, "end": 1}[line.get("text-anchor")]
            assert 0 < left < left + width < WIDTH, line.text
            assert float(line.get("y")) < SHEETS[name]["height"], line.text


def test_diagrams_are_those_of_the_script(tmp_path):
    # The others render, or depend on the last digits of an isophote, or on every import.
    for path in write_diagrams(tmp_path, ["geometry", "detection", "flow", "gate", "which_method"]):
        assert path.read_text() == (DOCS / "images" / path.name).read_text(), "python -m studies.manual diagrams"


def test_every_package_stands_in_the_map_of_layers(tmp_path):
    (path,) = write_diagrams(tmp_path, ["layers"])
    packages = {file.parent.name for file in (ROOT / "simtest").glob("*/__init__.py")} - {"__pycache__"}
    assert packages <= set(re.findall(r">(\w+)</text>", path.read_text()))
