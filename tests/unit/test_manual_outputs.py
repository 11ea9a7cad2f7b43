"""Outputs that the manual shows are compared with those that its commands print."""

import pytest

from studies.manual.blocks import Block, blocks_of
from studies.manual.outputs import Shown, difference, with_outputs
from studies.manual.runner import run_pages


def shown(text, *pieces, last_digits=False):
    """The output of a page."""
    return Shown(Block("page.md", 1, "text", text, False), pieces, last_digits)


@pytest.mark.parametrize(
    ("output", "printed"),
    [
        (shown("a\nb"), "a  \n\nb\n"),
        (shown("...\nb"), "a\nb\n"),
        (shown("a\n..."), "a\nb\nc\n"),
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
        (shown("a\nb"), "a\nc\n", "+c"),
        (shown("a"), "a\nb\n", "+b"),
        (shown("b"), "a\nb\n", "+a"),
        (shown("a\nb\n..."), "a\n", "-b"),
        (shown("a\n...\nb"), "b\na\n", "-..."),
        (shown("a b"), "a  b\n", "+a  b"),
        (shown("0.076 deg"), "0.077 deg", "+0.077"),
        (shown("0.076 deg", last_digits=True), "0.078 deg", "+0.078"),
        (shown("0.076 deg", last_digits=True), "0.0765 deg", "+0.0765"),
        (shown("0.076 deg", last_digits=True), "0.076 rad", "+0.076 rad"),
        (shown("12 found", last_digits=True), "13 found", "+13"),
        (shown("version 3.9.1", "3.9.2"), "version 3.9.2", "'3.9.2' does not stand"),
    ],
)
def test_other_outputs_are_found(output, printed, part):
    assert part in difference(output, printed)


PAGE = """# Page

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
    page.write_text(PAGE, encoding="utf-8")
    (shell, first), (python, second) = with_outputs(list(blocks_of(page)))
    assert (shell.language, python.language) == ("sh", "python")
    assert first == Shown(first.block, ("/home/me",), last_digits=True)
    assert second == Shown(second.block)
    assert second.block.code == "3"
    page.write_text("```sh\necho 1\n```\n\n# Files\n\n```text\n2\n```\n", encoding="utf-8")
    assert [each for _, each in with_outputs(list(blocks_of(page)))] == [None]


def test_a_session_shows_its_own_output(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.manual.runner.copy_checkout", lambda scratch: None)
    page = tmp_path / "page.md"
    session = "```console\n$ echo 1; exit 2\n1\n$ echo b /x\nb /y\n```\n"
    page.write_text(session, encoding="utf-8")
    assert list(with_outputs(list(blocks_of(page)))) == []
    page.write_text(f"<!-- session -->\n<!-- may vary: /y -->\n{session}", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
    page.write_text(f"<!-- session -->\n{session}", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 1
    assert "-b /y\n+b /x\n" in capsys.readouterr().out


def test_a_page_that_shows_another_output_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.manual.runner.copy_checkout", lambda scratch: None)
    page = tmp_path / "page.md"
    page.write_text(PAGE.replace("/srv", "/home/me"), encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 1
    said = capsys.readouterr().out
    assert "1 failed" in said
    assert "-3\n+2\n" in said
    page.write_text(PAGE.replace("/srv", "/home/me").replace("\n3\n", "\n2\n"), encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
    # The output of a command that is left out is not compared.
    page.write_text("```sh\necho 2\nsimtest nightly\n```\n```text\n3\n```\n", encoding="utf-8")
    assert run_pages([page], quick=True, timeout_s=60, log=None) == 0
