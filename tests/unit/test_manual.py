"""The manual: every page is reached, the reference is complete, commands and links work, and the checks find faults."""

import dataclasses
import inspect
import json
import re
import shutil
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from docstring_parser import parse

import simtest
from simtest.calibration import Calibration
from simtest.dataset.index import HighlightRow, SampleRow
from simtest.geometry import Camera
from simtest.reconstruction.constraints import constraints_arrays
from simtest.reconstruction.picture import Options, reconstruct_values
from simtest.runtime.files import as_json
from simtest.validation.column_meanings import MEANINGS
from simtest.validation.results_table import SCHEMA
from simtest.validation.runner import RunRecord
from simtest.validation.statistics import Figures
from studies.manual import tables
from studies.manual.api_page import SECTIONS, api_page, entries
from studies.manual.blocks import ROOT, blocks_of, manual_pages
from studies.manual.commands_page import command, commands, commands_page, shipped_page
from studies.manual.files_page import files_page
from studies.manual.keys_page import MODELS, keys_page
from studies.manual.links import anchors_of, dead_in_markdown, dead_links
from studies.manual.pages import PAGES
from studies.manual.runner import reads, run_pages
from studies.manual.stale import faults, stale

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


def test_generated_pages_are_not_in_git():
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()
    assert {f"docs/{name}" for name in PAGES} <= set(ignored)


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


def test_every_public_name_has_a_docstring():
    undocumented = [path for path, thing in entries().items() if callable(thing) and not inspect.getdoc(thing)]
    assert undocumented == []


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
    shipped = [*ROOT.glob("scenes/*.toml"), *ROOT.glob("scenes/*/*.toml")]
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
    assert set(MEANINGS) == set(SCHEMA)
    page = files_page()
    assert [name for name in SCHEMA if f"`{name}`" not in page] == []
    # An empty meaning is that of the column before: so the order is that of the table.
    columns = list(SCHEMA)
    for name, meaning in MEANINGS.items():
        before = columns[columns.index(name) - 1]
        assert meaning or name[:3] == before[:3], name


@pytest.mark.parametrize("record", [SampleRow, HighlightRow, RunRecord, Figures])
def test_docstrings_of_records_name_their_fields(record):
    named = [name for own in parse(inspect.getdoc(record)).params for name in own.arg_name.split(", ")]
    assert sorted(named) == sorted(field.name for field in dataclasses.fields(record))


def spot_picture():
    """A grey picture of one round highlight on a bright ground, 8 bits."""
    y, x = np.mgrid[:160, :200]
    return np.rint(60 + 180 * np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / (2 * 9.0**2))).astype(np.uint8)


def test_keys_of_normals_json_are_those_of_the_page():
    camera = Camera.from_fov(70.0, 200, 160)
    record = reconstruct_values("spot.png", spot_picture() / 255, Calibration(camera), Options(fov_deg=70.0))
    made = json.loads(json.dumps(record, default=as_json))
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


# Commands ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", manual_pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_command_of_the_manual_is_stale(page):
    assert list(stale([page])) == []


@pytest.mark.parametrize(
    ("code", "part"),
    [
        ("simtest render cylinder --out frame --colour red", "--colour"),
        ("simtest render cylindre --out frame", "cylindre"),
        ("simtest render cylinder --set surface.radius=5 --out frame", "radius"),
        ("simtest validate curvature --estimator cone_axes", "cone_axes"),
        ("simtest dataset tiny --set smaples=3 --out data", "smaples"),
        ("simtest validate curvature --set surface.radius=5", "radius"),
        ("simtest nightly --profile slow", "slow"),
        ("simtest glow", "glow"),
        ("python -m studies.nothing", "studies.nothing"),
        ("make coffee", "coffee"),
        ("simtest render cylinder --out frame && simtest render cone --out other", "cone"),
        ("simtest validate curvature \\\n    --realisation 5", "--realisation"),
    ],
)
def test_stale_commands_are_found(tmp_path, code, part):
    (block,) = blocks_of(written(tmp_path, f"# T\n\n```sh\n{code}\n```\n"))
    (fault,) = faults(block)
    assert part in fault


@pytest.mark.parametrize(
    "code",
    [
        "simtest render cylinder --set surface.radius_mm=5 --out frame   # a comment",
        "simtest --version",
        "OMP_NUM_THREADS=1 simtest validate curvature --realisations 5 --quiet > log.txt 2>&1",
        "simtest validate anatomy --set surface.path=my_colon.ply",
        "simtest reconstruct frame.png --camera camera.toml --out normals",
        "make demo",
        "python -m benchmarks dataset",
        "ls frame",
    ],
)
def test_sound_commands_are_no_faults(tmp_path, code):
    (block,) = blocks_of(written(tmp_path, f"```sh\n{code}\n```\n"))
    assert list(faults(block)) == []


@pytest.mark.parametrize(
    ("language", "code", "part"),
    [
        ("python", "import simtest\nsimtest.rendre('cylinder')", "simtest.rendre"),
        ("python", "from simtest.dataset import reed", "reed"),
        ("python", "print(", "Python"),
        ("toml", "a = ", "TOML"),
    ],
)
def test_stale_python_and_toml_are_found(tmp_path, language, code, part):
    (block,) = blocks_of(written(tmp_path, f"```{language}\n{code}\n```\n"))
    (fault,) = faults(block)
    assert part in fault


PAGE = """# Page

    simtest doctor

Text.

```sh
simtest schema scene
# a comment
simtest schema \\
    camera
```

```console
$ simtest render cylinder --set surface.radius_mm=-1 --out frame
simtest: no
```

<!-- own files -->
```python
open("mine.ply")
```

- item

  ```python
  print(1)
  ```
"""


def test_blocks_are_read_as_they_stand(tmp_path):
    blocks = list(blocks_of(written(tmp_path, PAGE)))
    assert [block.language for block in blocks] == ["indented", "sh", "console", "python", "python"]
    assert [block.runs for block in blocks] == [True, True, False, False, True]
    assert [block.line for block in blocks] == [3, 8, 15, 21, 27]
    assert blocks[1].lines == ["simtest schema scene", "simtest schema camera"]
    assert blocks[2].lines == ["simtest render cylinder --set surface.radius_mm=-1 --out frame"]
    assert blocks[4].code == "print(1)"
    # A refusal that is shown is meant.
    assert list(faults(blocks[2])) == []


def test_blocks_run_in_order_and_failures_are_counted(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.manual.runner._copy_checkout", lambda scratch: None)
    page = written(
        tmp_path,
        "```sh\necho 1 > made.txt\n```\n```python\ntext = open('made.txt').read()\n```\n"
        "```python\nassert text == '1\\n'\n```\n```console\nfalse\n```\n",
    )
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
    assert "all ran" in capsys.readouterr().out
    page.write_text("```sh\nfalse\n```\n```python\nraise SystemExit\n```\n```python\nx = 1\n```\n", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=tmp_path / "log") == 1
    said = capsys.readouterr().out
    assert said.count("FAILED") == 2
    assert "2 failed" in said
    page.write_text(
        "```sh\nsimtest validate overview --out run\n```\n```python\nopen('run/results.parquet')\n```\n",
        encoding="utf-8",
    )
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
    assert capsys.readouterr().out.count("left out") == 2
    assert reads("open('run/a.json')", ["run"])
    assert not reads("simtest render run_2 --out rerun; ls out/run", ["run"])
    page.write_text("```sh\nsleep 30\n```\n```sh\nsimtest nightly\nmake demo\n```\n", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=0.2, log=None) == 1
    said = capsys.readouterr().out
    assert "stopped after 0.2 s" in said
    assert said.count("left out") == 2


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


@pytest.mark.parametrize("page", manual_pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_link_in_markdown_is_dead(page):
    assert list(dead_in_markdown(page, {DOCS / name for name in PAGES})) == []


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


@pytest.mark.parametrize(
    ("tex", "parts"),
    [
        (r"\tfrac12", ["<mfrac", "<mn>1</mn>", "<mn>2</mn>"]),
        (r"a = b \tag{4.4}", ["(4.4)", "<mi>a</mi>"]),
        (r"\begin{cases} 1 & x > 0 \\ 0 \end{cases}", ["mtable"]),
    ],
)
def test_equations_become_mathml(monkeypatch, tex, parts):
    pytest.importorskip("sphinx", reason="sphinx is not installed: extra docs")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import mathml
    from docutils import nodes

    writer = SimpleNamespace(body=[])
    with pytest.raises(nodes.SkipNode):
        mathml.block(writer, nodes.math_block(tex, tex))
    made = "".join(writer.body)
    assert all(part in made for part in parts)
    assert "\\" not in made


@pytest.mark.extra
@pytest.mark.slow
def test_no_page_of_the_site_is_wider_than_the_screen():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: extra test")
    chromium = shutil.which("chromium")
    if chromium is None or not (SITE / "index.html").exists():
        pytest.skip("no Chromium on this system, or no site in build/manual: make docs")
    pages = sorted(path for path in SITE.rglob("*.html") if "_files" not in path.parts)
    wide = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for width in (1400, 1000, 390):
            page = browser.new_context(viewport={"width": width, "height": 900}).new_page()
            for path in pages:
                page.goto(path.as_uri())
                if page.evaluate("document.documentElement.scrollWidth") > width:
                    wide.append((width, path.relative_to(SITE).as_posix()))
        browser.close()
    assert wide == []
