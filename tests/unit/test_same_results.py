"""What compares the results of two versions sees each planted difference, and nothing where only the origin differs."""

import json

import numpy as np
import polars as pl
import pytest

from studies.same_results import COMPARE, NOT_COMPARED, differences, main

SUMMARY = {
    "run": {"commit": "a" * 40, "version": "0.2.0", "seed": 3, "duration_s": 2.0},
    "experiments": {"e": {"n": 1, "isolated": True, "run": {"commit": "kept at depth"}}},
    "highlights": [{"id": 0, "command": "kept at depth"}],
}
TABLE = pl.DataFrame({"id": [0, 1], "error_deg": [0.5, None], "experiment": ["e", "f"]})
PAGE = "<title>Run, 2026-01-02 03:04 UTC</title>\n<p>Median 0.25 deg</p>\n<tr><th>commit</th><td>aaa</td></tr>\n"


def write(folder):
    """Write a folder as a command leaves it: a file of each kind, in the folders that were once passed over too."""
    for path in ("", "figures", "history/date=2026-01-02/commit=abc"):
        (folder / path).mkdir(parents=True, exist_ok=True)
    (folder / "summary.json").write_text(json.dumps(SUMMARY), encoding="utf-8")
    (folder / "index.html").write_text(PAGE, encoding="utf-8")
    for suffix in (".md", ".svg", ".xml"):
        (folder / f"text{suffix}").write_text("median 0.25 deg\n", encoding="utf-8")
    for path in ("frame.png", "preview.jpg", "figures/curve.png"):
        (folder / path).write_bytes(b"bytes of a picture")
    np.save(folder / "normal.npy", np.arange(6.0))
    np.savez(folder / "truth.npz", depth=np.arange(6.0))
    TABLE.write_parquet(folder / "results.parquet")
    TABLE.write_parquet(folder / "history/date=2026-01-02/commit=abc/20260102T030405Z-77-0123abcd.parquet")
    return folder


def changed(change):
    """Return what writes summary.json with a change."""

    def rewrite(folder):
        value = json.loads(json.dumps(SUMMARY))
        change(value)
        (folder / "summary.json").write_text(json.dumps(value), encoding="utf-8")

    return rewrite


def replaced(name, old, new):
    """Return what replaces bytes of a file."""

    def replace(folder):
        data = (folder / name).read_bytes()
        assert old in data
        (folder / name).write_bytes(data.replace(old, new))

    return replace


PLANTED = {
    "an id at depth": (changed(lambda v: v["highlights"][0].update(id=7)), "summary.json"),
    "an origin at depth": (changed(lambda v: v["experiments"]["e"]["run"].update(commit="b")), "summary.json"),
    "a seed beside the origin": (changed(lambda v: v["run"].update(seed=4)), "summary.json"),
    "1 for true": (changed(lambda v: v["experiments"]["e"].update(isolated=1)), "summary.json"),
    "1.0 for 1": (changed(lambda v: v["experiments"]["e"].update(n=1.0)), "summary.json"),
    "an empty list for none": (changed(lambda v: v.update(clouds=[])), "summary.json"),
    "a file that is gone": (lambda f: (f / "frame.png").unlink(), "frame.png"),
    "a file that is new": (lambda f: (f / "extra.csv").write_text("1\n"), "extra.csv"),
    "a file of an unknown kind": (lambda f: (f / "model.xyz").write_text("1\n"), "model.xyz"),
    "a figure": (replaced("figures/curve.png", b"bytes", b"BYTES"), "figures/curve.png"),
    "a page's figure": (replaced("index.html", b"0.25", b"0.26"), "index.html"),
    "a text": (replaced("text.svg", b"0.25", b"0.26"), "text.svg"),
    "an array": (lambda f: np.save(f / "normal.npy", np.arange(6.0) + 1e-15), "normal.npy"),
    "an array's type": (lambda f: np.savez(f / "truth.npz", depth=np.arange(6)), "truth.npz"),
    "a table's rows in reverse": (lambda f: TABLE.reverse().write_parquet(f / "results.parquet"), "results.parquet"),
    "a null for NaN": (
        lambda f: TABLE.with_columns(error_deg=pl.Series([0.5, np.nan])).write_parquet(f / "results.parquet"),
        "results.parquet",
    ),
    "a history's figure": (
        lambda f: TABLE.with_columns(error_deg=pl.Series([0.5, 0.5])).write_parquet(next(f.rglob("2026*.parquet"))),
        "history/date/commit/run.parquet",
    ),
}


@pytest.mark.parametrize("planted", PLANTED)
def test_a_planted_difference_is_seen_and_no_other(planted, tmp_path):
    before, after = write(tmp_path / "figures" / "before"), write(tmp_path / "after")
    change, name = PLANTED[planted]
    change(after)
    assert [found for found, how in differences(before, after).items() if how] == [name]
    assert main([str(before), str(after)]) == 1
    if planted not in ("a file that is gone", "a file that is new", "a file of an unknown kind"):
        assert main([str(after), str(before)]) == 1


def test_folders_that_are_mistyped_or_empty_are_not_equal(tmp_path, capsys):
    sound, empty = write(tmp_path / "sound"), tmp_path / "empty"
    empty.mkdir()
    assert main([str(tmp_path / "mistyped"), str(sound)]) == 2
    assert main([str(sound), str(tmp_path / "mistyped")]) == 2
    assert "mistyped: no such folder" in capsys.readouterr().err
    assert main([str(empty), str(empty)]) == 2
    assert main([str(empty), str(sound)]) == main([str(sound), str(empty)]) == 1
    assert main([str(sound), str(sound)]) == 0
    with pytest.raises(SystemExit, match="2"):
        main([str(sound)])


def shifted(folder, shift, **others):
    """Return a folder whose floats are moved in each kind of file, and in whose JSON other values are set."""
    np.save(folder / "normal.npy", np.append(np.arange(6.0), np.inf) + shift)
    np.savez(folder / "truth.npz", depth=np.append(np.arange(6.0), np.nan) + shift)
    TABLE.with_columns(pl.col("error_deg") + shift).write_parquet(folder / "results.parquet")
    changed(lambda v: v["experiments"]["e"].update({"mean": 0.25 + shift, **others}))(folder)
    return folder


def test_a_tolerance_holds_for_floats_and_for_nothing_else(tmp_path, capsys):
    before, after = (shifted(write(tmp_path / str(shift)), shift) for shift in (0.0, 3e-7))
    names = {"normal.npy", "truth.npz", "results.parquet", "summary.json"}
    assert {name for name, how in differences(before, after).items() if how} == names
    assert main([str(before), str(after), "--tolerance", "1e-6"]) == 0
    assert "largest difference of equal files' floats: 3e-07" in capsys.readouterr().out
    assert main([str(before), str(after), "--tolerance", "1e-7"]) == 1
    for others in ({}, {"n": 2}, {"isolated": False}, {"mean": 1}, {"mean": None}):
        shifted(after, 3e-7, **others)
        assert main([str(before), str(after), "--tolerance", "9"]) == int(bool(others)), others


def test_the_words_of_a_page_are_compared_without_its_markup(tmp_path):
    before, after = write(tmp_path / "before"), write(tmp_path / "after")
    page = PAGE.replace("<p>Median", "<script>draw()</script><p class='x'>\nMedian")
    (after / "index.html").write_text(page, encoding="utf-8")
    assert main([str(before), str(after)]) == 1
    assert main([str(before), str(after), "--words"]) == 0
    (after / "index.html").write_text(page.replace("0.25", "0.26"), encoding="utf-8")
    assert main([str(before), str(after), "--words"]) == 1


def test_each_suffix_is_compared_or_has_a_reason(tmp_path, capsys):
    assert not COMPARE.keys() & NOT_COMPARED.keys()
    main([str(write(tmp_path))] * 2)
    output = capsys.readouterr().out
    assert all(f"not compared: {suffix}, which {why}" in output for suffix, why in NOT_COMPARED.items() if why)
    assert all(NOT_COMPARED.values())


@pytest.mark.render
def test_another_origin_of_real_files_is_no_difference(here, tmp_path, monkeypatch):
    from simtest.runtime import provenance

    render = ("render", "plane", "--out")
    rendered = tmp_path / "before" / "render"
    reconstruct = ("reconstruct", rendered / "frame.png", "--camera", rendered / "camera.toml", "--out")
    for name in ("before", "after"):
        assert here(*render, tmp_path / name / "render")[0] == 0
        assert here(*reconstruct, tmp_path / name / "answer")[0] == 0
        monkeypatch.setattr(provenance, "commit", lambda: "f" * 40)
        monkeypatch.setattr(provenance, "version", lambda: "9.9.9")
        monkeypatch.setattr(provenance, "processor", lambda: "another")
    found = differences(tmp_path / "before", tmp_path / "after")
    assert len(found) >= 13
    assert not any(found.values())
