"""A run's page: written once, again where anything it is made of has changed, and whole at every moment."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from simtest.report import page, write, write_report
from tests.marked import marked
from tests.unit.test_report import make_run

LINK = r'<a class="png" href="([^"]*)">PNG</a>'


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    made = make_run(tmp_path_factory.mktemp("run") / "run", items=2, realisations=3)
    write_report(made, charts=True)
    return made


@pytest.fixture
def run(drawn, tmp_path):
    """Return a run of one's own with its page; times of files are kept."""
    return Path(shutil.copytree(drawn, tmp_path / "run"))


def contents(run):
    files = [run / "index.html", run / "guide.json", *sorted((run / "figures").iterdir())]
    return {file.name: file.read_bytes() for file in files}


def draws(monkeypatch, run):
    """Whether another call draws the page again."""
    drawn = []
    draw = page.draw_page
    monkeypatch.setattr(page, "draw_page", lambda *arguments: drawn.append(1) or draw(*arguments))
    assert write_report(run, charts=True) == run / "index.html"
    return bool(drawn)


def test_a_page_that_is_up_to_date_stays(run, monkeypatch):
    before = {
        file: file.stat().st_mtime_ns for file in (run / "index.html", run / "guide.json", *(run / "figures").iterdir())
    }
    told = []
    assert not draws(monkeypatch, run)
    write_report(run, lambda *step: told.append(step))
    write_report(run, lambda *step: told.append(step), charts=True)
    assert not told
    assert {file: file.stat().st_mtime_ns for file in before} == before


def replaced(old, new):
    """Return what edits the text of a file."""
    return lambda file: file.write_text(file.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


DAMAGE = {
    "guide removed": ("guide.json", Path.unlink),
    "guide edited": ("guide.json", replaced("median", "mean")),
    "figure removed": ("figures/axis_ratio.png", Path.unlink),
    "figure cut": ("figures/gallery_001.png", lambda file: file.write_bytes(file.read_bytes()[:-20])),
    "page cut": ("index.html", cut),
    "page edited": ("index.html", replaced("Title of", "Titel of")),
    "note spoiled": ("index.html", replaced('{"key":', '["key":')),
}


@pytest.mark.parametrize("what", marked([*DAMAGE], ci=[*DAMAGE.keys() - {"guide edited", "figure removed"}]))
def test_what_is_damaged_is_written_again(run, monkeypatch, what):
    whole = contents(run)
    name, damage = DAMAGE[what]
    damage(run / name)
    assert draws(monkeypatch, run)
    assert contents(run) == whole


def test_what_the_page_is_made_of_counts(run, monkeypatch, tmp_path):
    other = make_run(tmp_path / "other", items=2, realisations=4)
    for name in ("results.parquet", "summary.json"):
        (run / name).write_bytes((other / name).read_bytes())
        assert draws(monkeypatch, run), name
    (run / "gallery" / "item_01.npz").unlink()
    assert draws(monkeypatch, run)
    # Pictures of the earlier page have gone.
    assert not (run / "figures" / "gallery_001.png").exists()
    assert not draws(monkeypatch, run)


def test_other_code_or_versions_draw_the_page_again(run, monkeypatch):
    monkeypatch.setattr(write, "_code", lambda: "other")
    assert draws(monkeypatch, run)
    monkeypatch.setattr(write, "versions", lambda: {"simtest": "99"})
    assert draws(monkeypatch, run)


def steps_of(run):
    told = []
    write_report(run, lambda *step: told.append(step), charts=True)
    return told


def test_every_figure_and_frame_is_a_step(tmp_path):
    run = make_run(tmp_path, items=2, realisations=3)
    told = steps_of(run)
    done, total, texts = zip(*told, strict=True)
    count = len(list((run / "figures").iterdir()))
    assert told[-1] == (count + 1, count + 1, "page written")
    assert list(done) == sorted(done)
    assert all(0 <= some <= all_ for some, all_ in zip(done, total, strict=True))
    # The last step but one is writing the page, once all figures are there.
    assert told[-2] == (count, count + 1, "writing the page")
    assert {"reading the results", "comparing with the laws", "describing error_vs_curvature"} <= set(texts)


@pytest.mark.ci  # meanwhile: test_realism_page for a stop, and what is damaged above
def test_a_stop_leaves_the_earlier_page_and_the_next_call_makes_it_whole(run, tmp_path):
    # New results over an earlier page.
    other = make_run(tmp_path / "other", items=3, realisations=4)
    for file in ("results.parquet", "summary.json", "gallery/item_02.npz"):
        (run / file).write_bytes((other / file).read_bytes())
    before = (run / "index.html").read_bytes()
    least = len(steps_of(other)) // 2
    for stop in (1, 2, least):
        told = []

        def press(*step, stop=stop, told=told):
            told.append(step)
            if len(told) == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_report(run, press, charts=True)
        assert (run / "index.html").read_bytes() == before
        assert not list((run / "figures").glob(".*"))
    write_report(run, charts=True)
    assert contents(run) == contents(other)


def test_charts_are_files_where_they_are_asked_for(run):
    (run / "index.html").unlink()
    write_report(run)
    assert {file.stem for file in (run / "figures").iterdir()} == {"gallery_000", "gallery_001"}
    # The same page but for its links, and what is missing beside it.
    text = (run / "index.html").read_text(encoding="utf-8").rpartition("<!--")[0]
    assert not re.findall(LINK, text)
    write_report(run, charts=True)
    assert (run / "figures" / "axis_ratio.png").stat().st_size > 5000
    linking = (run / "index.html").read_text(encoding="utf-8").rpartition("<!--")[0]
    files = re.findall(LINK, linking)
    assert "figures/axis_ratio.png" in files
    assert all((run / file).is_file() for file in files)
    assert re.sub(LINK, "", linking) == text


def test_a_frame_that_cannot_be_drawn_stops_the_page(run, monkeypatch):
    before = (run / "index.html").read_bytes()
    (run / "figures" / "axis_ratio.png").unlink()

    def fail(*_):
        raise RuntimeError("no ink")

    monkeypatch.setattr(page, "draw_shown", fail)
    with pytest.raises(RuntimeError, match="no ink"):
        write_report(run)
    assert (run / "index.html").read_bytes() == before


def test_a_page_is_drawn_without_matplotlib_and_kept_without_what_draws_it(run):
    (run / "index.html").unlink()
    script = (
        "import sys; from pathlib import Path; from simtest.report import write_report;"
        "write_report(Path(sys.argv[1]));"
        "print(*sorted({'matplotlib', 'scipy.stats', 'mitsuba', 'cv2', 'polars', 'jinja2', 'PIL'} & set(sys.modules)))"
    )
    loaded = [
        subprocess.run([sys.executable, "-c", script, run], capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert loaded == [["PIL", "cv2", "jinja2", "polars"], []]
