"""Commands and code in the manual: none is stale, all are run as they stand, and the checks find faults."""

import pytest

from studies.manual.blocks import ROOT, blocks_of, manual_pages
from studies.manual.runner import outputs_of, reads, run_pages
from studies.manual.stale import faults, stale


def written(tmp_path, text):
    """A page of the given text, as the blocks on it."""
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    return page


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
    monkeypatch.setattr("studies.manual.runner.copy_checkout", lambda scratch: None)
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
    assert outputs_of("simtest validate dense --out run --export frames") == ["run", "frames"]
    assert outputs_of("simtest validate dense --export frames") == ["frames", "reports/runs/dense"]
    assert reads("open('run/a.json')", ["run"])
    assert not reads("simtest render run_2 --out rerun; ls out/run", ["run"])
    page.write_text("```sh\nsleep 30\n```\n```sh\nsimtest nightly\nmake demo\n```\n", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=0.2, log=None) == 1
    said = capsys.readouterr().out
    assert "stopped after 0.2 s" in said
    assert said.count("left out") == 2
