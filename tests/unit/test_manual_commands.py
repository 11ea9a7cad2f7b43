"""Commands, code, outputs and tables of the manual: none is stale, all are made anew, and the checks find faults."""

import re
from importlib.util import find_spec

import pytest

from simtest.spec import load_experiment
from studies.manual.blocks import Block, blocks_of, manual_pages
from studies.manual.figures import CHEAP, Table, check_figures, tables_of
from studies.manual.figures import differences as table_differences
from studies.manual.outputs import Shown, difference, with_outputs
from studies.manual.runner import outputs_of, reads, run_pages
from studies.manual.stale import faults, stale


def written(tmp_path, text):
    """A page of the given text, as the blocks on it."""
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    return page


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch):
    """Run commands in their scratch folder, without a copy of the checkout."""
    for module in ("runner", "figures"):
        monkeypatch.setattr(f"studies.manual.{module}.copy_checkout", lambda scratch: None)


def test_no_command_of_the_manual_is_stale():
    assert list(stale(manual_pages())) == []


@pytest.mark.parametrize(
    ("code", "part"),
    [
        ("simtest render cylindre --out frame", "cylindre"),
        ("simtest dataset tiny --set smaples=3 --out data", "smaples"),
        ("simtest nightly --profile slow", "slow"),
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
        "OMP_NUM_THREADS=1 simtest validate curvature --realisations 5 --quiet > log.txt 2>&1",
        "simtest validate anatomy --set surface.path=my_colon.ply",
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
        ("python", "print(", "Python"),
        ("toml", "a = ", "TOML"),
    ],
)
def test_stale_python_and_toml_are_found(tmp_path, language, code, part):
    (block,) = blocks_of(written(tmp_path, f"```{language}\n{code}\n```\n"))
    (fault,) = faults(block)
    assert part in fault


BLOCKS = """# Page

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
    blocks = list(blocks_of(written(tmp_path, BLOCKS)))
    assert [block.language for block in blocks] == ["indented", "sh", "console", "python", "python"]
    assert [block.runs for block in blocks] == [True, True, False, False, True]
    assert [block.line for block in blocks] == [3, 8, 15, 21, 27]
    assert blocks[1].lines == ["simtest schema scene", "simtest schema camera"]
    assert blocks[2].lines == ["simtest render cylinder --set surface.radius_mm=-1 --out frame"]
    assert blocks[4].code == "print(1)"
    # A refusal that is shown is meant.
    assert list(faults(blocks[2])) == []


def test_blocks_run_in_order_and_failures_are_counted(tmp_path, capsys):
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


def shown(text, *pieces, last_digits=False):
    """The output of a page."""
    return Shown(Block("page.md", 1, "text", text, False), pieces, last_digits)


@pytest.mark.parametrize(
    ("output", "printed"),
    [
        (shown("a\nb"), "a  \n\nb\n"),
        (shown("a\n...\nd\n..."), "a\nb\nc\nd\n"),
        (shown("a\n...\nb\n...\nb"), "a\nb\nb\n"),
        (shown("a"), "\x1b[1ma\x1b[0m\n"),
        (shown("a"), "simtest: 7/20 my_colon (38 s, about 70 s left)\na\n"),
        (shown("in /home/me, 3.1", "/home/me", "3.1"), "in /srv, 4.22"),
        (shown("off by 0.076 deg, -1.50", last_digits=True), "off by 0.077 deg, -1.49"),
        (shown("0.5 in /home/me/0.3", "/home/me/0.3", last_digits=True), "0.4 in /srv"),
    ],
)
def test_an_output_as_shown(output, printed):
    assert difference(output, printed) is None


@pytest.mark.parametrize(
    ("output", "printed", "part"),
    [
        (shown("a"), "a\nb\n", "+b"),
        (shown("a\nb\n..."), "a\n", "-b"),
        (shown("a\n...\nb"), "b\na\n", "-..."),
        (shown("0.076 deg"), "0.077 deg", "+0.077"),
        (shown("0.076 deg", last_digits=True), "0.078 deg", "+0.078"),
        (shown("0.076 deg", last_digits=True), "0.0765 deg", "+0.0765"),
        (shown("12 found", last_digits=True), "13 found", "+13"),
        (shown("version 3.9.1", "3.9.2"), "version 3.9.2", "'3.9.2' does not stand"),
    ],
)
def test_other_outputs_are_found(output, printed, part):
    assert part in difference(output, printed)


OUTPUTS = """# Page

```sh
echo 1.25 of /home/me
```

It prints

<!-- may vary: last digits;
     /home/me -->
```text
1.26 of /srv
```

```python
x = 2
print(x)
```
```text
3
```

## Files

```text
no output
```

```console
$ echo 1
```
```text
5
```
"""


def test_outputs_belong_to_the_block_before_them(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(OUTPUTS, encoding="utf-8")
    (shell, first), (python, second) = with_outputs(list(blocks_of(page)))
    assert (shell.language, python.language) == ("sh", "python")
    assert first == Shown(first.block, ("/home/me",), last_digits=True)
    assert second == Shown(second.block)
    assert second.block.code == "3"
    page.write_text("```sh\necho 1\n```\n\n# Files\n\n```text\n2\n```\n", encoding="utf-8")
    assert [each for _, each in with_outputs(list(blocks_of(page)))] == [None]


def test_a_session_shows_its_own_output(tmp_path, capsys):
    page = tmp_path / "page.md"
    session = "```console\n$ echo 1; exit 2\n1\n$ echo b /x\nb /y\n```\n"
    page.write_text(session, encoding="utf-8")
    assert list(with_outputs(list(blocks_of(page)))) == []
    page.write_text(f"<!-- session -->\n<!-- may vary: /y -->\n{session}", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
    page.write_text(f"<!-- session -->\n{session}", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 1
    assert "-b /y\n+b /x\n" in capsys.readouterr().out


def test_a_page_that_shows_another_output_fails(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text(OUTPUTS.replace("/srv", "/home/me"), encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 1
    said = capsys.readouterr().out
    assert "1 failed" in said
    assert "-3\n+2\n" in said
    page.write_text(OUTPUTS.replace("/srv", "/home/me").replace("\n3\n", "\n2\n"), encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
    # The output of a command that is left out is not compared.
    page.write_text("```sh\necho 2\nsimtest nightly\n```\n```text\n3\n```\n", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0


ALL = [table for page in manual_pages() for table in tables_of(page)]
FIGURES = """Before.

<!-- made by: printf '%s\\n' '{row}' && true; minutes: 0.01{options} -->

| d k | found | error |
|---|---|---|
| -0.5 | 1,036 | 0.017 (99 %) |

After.
"""


def table(*rows, within=0.0, part=False):
    return Table("page.md:1", "", 0.1, within, part, tuple(tuple(row.split("|")) for row in rows))


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        (table("plane | 0.017 | 32"), "| plane | 0.018 | 31 |"),
        (table("plane | 0.017 | 32"), "plane: 0.01721 and 32.4"),
        (table("k d = -0.5 | 1,036"), "k d = -0.5 | 1036"),
        (table("1 | 9e-12"), "1 | 9.8e-12"),
        (table("1 | 1.3e-15"), "1 | 6.4e-15"),
        (table("a | 0.5", "b | 0.7"), "b | 0.7\na | 0.5"),
        (table("a | 100", within=0.05), "a | 104"),
        (table("a | 0.5 | 0.9", part=True), "a | 0.5 | 7 | 0.9 | 3"),
        (table("a | missed", "b | 0.5"), "b | 0.5"),
    ],
)
def test_a_table_as_printed(shown, printed):
    assert table_differences(shown, printed) == []


@pytest.mark.parametrize(
    ("shown", "printed", "found"),
    [
        (table("plane | 0.017 | 32"), "plane | 0.019 | 32", "plane | 0.017 | 32: 0.017 is 0.019"),
        (table("plane | 0.017 | 32"), "plane | 0.017", "plane | 0.017 | 32: no such row is printed"),
        (table("a | 0.5", "b | 0.5"), "a | 0.5", "b | 0.5: no such row is printed"),
        (table("a | 100", within=0.05), "a | 106", "a | 100: 100 is 106"),
        (table("a | 0.5 | 0.9", part=True), "a | 0.9 | 0.5", "a | 0.5 | 0.9: 0.9 is not printed"),
        (table("a | 0.5"), "a | -0.5", "a | 0.5: 0.5 is -0.5"),
        (table("1 | 9e-12"), "1 | 9e-11", "1 | 9e-12: 9e-12 is 9e-11"),
        (table("a | 0.50 | 0.60"), "a | 0.52 | 0.60\nb | 0.70 | 0.80", "a | 0.50 | 0.60: 0.50 is 0.52"),
    ],
)
def test_a_table_that_differs(shown, printed, found):
    assert table_differences(shown, printed) == [found]


def test_tables_of_a_page_are_made_by_their_commands(tmp_path, capsys):
    page = tmp_path / "page.md"

    def check(row, options="", cheap=False):
        page.write_text(FIGURES.format(row=row, options=options), encoding="utf-8")
        return check_figures([page], cheap, 60), capsys.readouterr().out

    assert check("-0.5 1036 0.018 99")[0] == 0
    code, said = check("-0.5 1036 0.019 99")
    assert (code, "0.017 is 0.019" in said, "1 of 1 tables differ" in said) == (1, True, True)
    assert check("-0.5 1036 0.0179 99", "; within: 10 %")[0] == 0
    assert check("-0.5 1036 7 0.017 99", "; part")[0] == 0
    page.write_text(FIGURES.format(row="1", options="").replace("0.01 -->", "5 -->"), encoding="utf-8")
    assert check_figures([page], True, 60) == 0
    assert "left out" in capsys.readouterr().out
    page.write_text(FIGURES.format(row="1", options="").replace("true", "echo broken; false"), encoding="utf-8")
    assert check_figures([page], False, 60) == 1
    assert "broken" in capsys.readouterr().out


def test_numbers_that_differ_are_written_on_request(tmp_path, capsys):
    page, row = tmp_path / "page.md", "-0.5 1,040 0.123 98"
    page.write_text(FIGURES.format(row=row, options=""), encoding="utf-8")
    assert check_figures([page], False, 60, write=True) == 1
    assert "0.017 is 0.123" in capsys.readouterr().out
    assert "\n| -0.5 | 1,040 | 0.123 (98 %) |\n\nAfter.\n" in page.read_text(encoding="utf-8")
    assert check_figures([page], False, 60, write=True) == 0
    # What does not say which numbers it leaves out, or is not printed, stays.
    for text in (FIGURES.format(row=row + " 7 7", options="; part"), FIGURES.format(row="0.5 1 1 1", options="")):
        page.write_text(text, encoding="utf-8")
        assert check_figures([page], False, 60, write=True) == 1
        assert page.read_text(encoding="utf-8") == text


def test_a_comment_without_a_table_is_named(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("\n<!-- made by: true; minutes: 1 -->\nno table\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"page\.md:2: no table stands below"):
        list(tables_of(page))


def test_commands_of_the_manuals_tables_exist():
    assert len(ALL) >= 10
    # A comment that is misspelt is no table's.
    assert len(ALL) == sum(page.read_text(encoding="utf-8").count("<!-- made by:") for page in manual_pages())
    for each in ALL:
        assert [row for row in each.rows if re.search(r"\d", "|".join(row))], each.place
        for part in each.command.split(" && "):
            words = part.split()
            if words[:2] == ["simtest", "validate"]:
                load_experiment(words[2])
            elif words[:2] == ["python", "-m"]:
                assert find_spec(words[2]), f"{each.place}: {words[2]}"
    cheap = {part: each.minutes for each in ALL if each.minutes <= CHEAP for part in each.command.split(" && ")}
    assert sum(cheap.values()) < 6
