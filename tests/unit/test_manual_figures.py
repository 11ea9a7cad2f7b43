"""Tables of measured figures in the manual name their command, and are compared with what it prints."""

import re
from importlib.util import find_spec

import pytest

from simtest.spec import load_experiment
from studies.manual.blocks import manual_pages
from studies.manual.figures import CHEAP, Table, check_figures, differences, tables_of

ALL = [table for page in manual_pages() for table in tables_of(page)]

PAGE = """Before.

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
        (table("plane | 0.017 | 32"), "| plane | 0.017 | 32 |"),
        (table("plane | 0.017 | 32"), "| plane | 0.018 | 31 |"),
        (table("plane | 0.017 | 32"), "plane: 0.01721 and 32.4"),
        (table("k d = -0.5 | 1,036"), "k d = -0.5 | 1036"),
        (table("1 | 9e-12"), "1 | 9.8e-12"),
        (table("a | 0.5", "b | 0.7"), "b | 0.7\na | 0.5"),
        (table("a | 100", within=0.05), "a | 104"),
        (table("a | 0.5 | 0.9", part=True), "a | 0.5 | 7 | 0.9 | 3"),
        (table("a | missed", "b | 0.5"), "b | 0.5"),
    ],
)
def test_a_table_as_printed(shown, printed):
    assert differences(shown, printed) == []


@pytest.mark.parametrize(
    ("shown", "printed", "found"),
    [
        (table("plane | 0.017 | 32"), "plane | 0.019 | 32", "plane | 0.017 | 32: 0.017 is 0.019"),
        (table("plane | 0.017 | 32"), "plane | 0.017", "plane | 0.017 | 32: no such row is printed"),
        (table("plane | 0.017"), "plane | 0.017 | 32", "plane | 0.017: no such row is printed"),
        (table("k d = 1 | 0.5"), "k d = 2 | 0.5", "k d = 1 | 0.5: no such row is printed"),
        (table("a | 0.5", "b | 0.5"), "a | 0.5", "b | 0.5: no such row is printed"),
        (table("a | 100", within=0.05), "a | 106", "a | 100: 100 is 106"),
        (table("a | 0.5 | 0.9", part=True), "a | 0.9 | 0.5", "a | 0.5 | 0.9: 0.9 is not printed"),
        (table("a | 0.5"), "a | -0.5", "a | 0.5: 0.5 is -0.5"),
        (table("1 | 9e-12"), "1 | 9e-11", "1 | 9e-12: 9e-12 is 9e-11"),
        (table("a | 0.50 | 0.60"), "a | 0.52 | 0.60\nb | 0.70 | 0.80", "a | 0.50 | 0.60: 0.50 is 0.52"),
    ],
)
def test_a_table_that_differs(shown, printed, found):
    assert differences(shown, printed) == [found]


def test_tables_of_a_page_are_made_by_their_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("studies.manual.figures.copy_checkout", lambda scratch: None)
    page = tmp_path / "page.md"

    def check(row, options="", cheap=False):
        page.write_text(PAGE.format(row=row, options=options), encoding="utf-8")
        return check_figures([page], cheap, 60), capsys.readouterr().out

    assert check("-0.5 1036 0.018 99")[0] == 0
    code, said = check("-0.5 1036 0.019 99")
    assert (code, "0.017 is 0.019" in said, "1 of 1 tables differ" in said) == (1, True, True)
    assert check("-0.5 1036 0.0179 99", "; within: 10 %")[0] == 0
    assert check("-0.5 1036 7 0.017 99", "; part")[0] == 0
    page.write_text(PAGE.format(row="1", options="").replace("0.01 -->", "5 -->"), encoding="utf-8")
    assert check_figures([page], True, 60) == 0
    assert "left out" in capsys.readouterr().out
    page.write_text(PAGE.format(row="1", options="").replace("true", "echo broken; false"), encoding="utf-8")
    assert check_figures([page], False, 60) == 1
    assert "broken" in capsys.readouterr().out


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
