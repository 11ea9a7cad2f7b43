"""Charts: records become specifications that Vega takes, whose rows are the records' numbers; and Vega itself."""

import base64
import io
import json
import sys
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import vl_convert
from PIL import Image

from simtest.pages import charts, pixels
from simtest.pages.charts import NOTHING, Axis, Bars, Chart, Mark, Panel, Picture, label_keys, log_range, png, spec
from simtest.pages.style import SHAPES, rgb

RED, BLUE = "#D03030", "#0072B2"


def chart(*marks, x=None, y=None, **more):
    return Chart("key", "Title", (Panel(x or Axis("x"), y or Axis("y", "log"), marks),), **more)


def rows_of(made, kind, panel=0):
    """The rows of the layers of one kind of a chart's panel."""
    whole = spec(made)
    view = whole["vconcat"][panel] if "vconcat" in whole else whole
    return [row for layer in view["layer"] if layer["mark"]["type"] == kind for row in layer["data"]["values"]]


def test_a_name_has_one_entry_of_its_first_line_or_symbol():
    bars = Mark([1.0], [1.0], RED, "a", bars=Bars(np.array([0.5]), np.array([2.0])))
    law = Mark([1, 2], [1, 2], RED, "a", listed=False, line="dash")
    points = Mark([1, 2], [1, 2], RED, "a", symbol="●")
    made = chart(
        bars, law, points, Mark([1, 2], [1, 2], BLUE, "b", line="solid"), Mark(NOTHING, NOTHING, RED, "c", line="dash")
    )
    assert [mark.name for mark in made.entries] == ["a", "b", "c"]
    assert made.entries[0] is points
    # All rows of a name are hidden together.
    assert {row["name"] for kind in ("rule", "line", "point") for row in rows_of(made, kind)} == {"a", "b"}
    assert all(layer["transform"] == [{"filter": "indexof(off, datum.name) < 0"}] for layer in spec(made)["layer"])


def test_the_rows_are_the_marks():
    bars = Bars(np.array([0.0, 0.5]), np.array([2.0, 3.0]), 1.2)
    made = chart(
        Mark([1, 2], [1.0, 2.0], RED, "a", symbol="▲", size=8, bars=bars, hover=["one\nmore", "two"]),
        Mark([1, 2], [1.0, 2.0], BLUE, words=["4", "5"], bold=True),
        Mark([1, 1, 3, 3], [1, 2, 2, 1], BLUE, fill=True, hover="tile"),
    )
    low = spec(made)["layer"][0]["encoding"]["y"]["scale"]["domain"][0]
    # A bar that leaves a logarithmic axis is drawn to its edge, without a cap there.
    assert [(row["low"], row["high"]) for row in rows_of(made, "rule")] == [
        (pytest.approx(low, rel=1e-4), 2.0), (0.5, 3.0)
    ]  # fmt: skip
    caps = [row["y"] for row in rows_of(made, "point") if row["shape"] == SHAPES["–"]]
    assert caps == [2.0, 0.5, 3.0]
    points = [row for row in rows_of(made, "point") if row["shape"] == "triangle-up"]
    assert [(row["x"], row["y"], row["told"], row["size"]) for row in points] == [
        (1, 1, "one\nmore", 64), (2, 2, "two", 64)
    ]  # fmt: skip
    assert [(row["text"], row["bold"]) for row in rows_of(made, "text")] == [("4", True), ("5", True)]
    (tile,) = rows_of(made, "rect")
    assert (tile["x"], tile["x2"], tile["y"], tile["y2"], tile["told"]) == (1, 3, 1, 2, "tile")


def test_a_line_has_gaps_where_points_are_missing_or_no_axis_shows_them():
    made = chart(Mark([1, 2, np.nan, 4, 5, 6], [1.0, 2.0, 3.0, 0.0, 5.0, 6.0], RED, line="dash", width=2))
    pieces = {}
    for row in rows_of(made, "line"):
        pieces.setdefault(row["piece"], []).append(row["x"])
    assert list(pieces.values()) == [[1, 2], [5, 6]]
    assert {row["dash"] for row in rows_of(made, "line")} == {"dash"}
    # Two lines are never joined.
    two = chart(Mark([1, 2], [1, 1], RED, line="solid"), Mark([3, 4], [1, 1], RED, line="solid"))
    assert len({row["piece"] for row in rows_of(two, "line")}) == 2


def test_a_hover_may_hold_the_points_coordinates_or_nothing():
    law = Mark([-1.0, 1.0], [1.0, 2.0], RED, line="dash", hover="law {x}: {y}")
    made = chart(law, Mark([1, 2], [1.0, 2.0], RED, symbol="●"), x=Axis("x", "stretched"))
    told = rows_of(made, "point")
    assert [row["told"] for row in told] == ["law -1: 1", "law 1: 2", "", ""]
    # Points that are only told of are not seen.
    assert [row["opacity"] > 0 for row in told] == [False, False, True, True]
    assert spec(made)["layer"][0]["encoding"]["x"]["scale"]["type"] == "symlog"


def test_panels_share_x_and_the_height():
    lower = Panel(
        Axis("x"), Axis("failures", limits=(0, 1), named=()), (Mark([1, 9], [0.5, 0.5], RED, words="ab"),), 0.25
    )
    upper = Panel(Axis("x"), Axis("y"), (Mark([1, 2], [1, 2], BLUE, line="solid"),))
    above, below = spec(Chart("key", "Title", (upper, lower)))["vconcat"]
    x_above, x_below = (view["layer"][0]["encoding"]["x"] for view in (above, below))
    assert x_above["scale"] == x_below["scale"]
    assert (x_above["axis"]["labels"], x_below["axis"]["labels"]) == (False, True)
    assert above["height"] == pytest.approx(4 * below["height"], abs=2)
    assert below["layer"][0]["encoding"]["y"]["axis"]["values"] == []


def test_axes_of_one_scale_keep_it():
    axes = Axis("x", limits=(0.0, 4.0)), Axis("y", limits=(2.0, 0.0))
    mark = Mark([0, 3], [0, 1], RED, line="solid", head=True)
    picture = Picture(np.full((2, 4), 0.5, np.float32), (0.0, 4.0, 2.0, 0.0))
    made = spec(Chart("key", "Title", (Panel(*axes, (mark,), equal=True, picture=picture),)))
    assert made["width"] == 2 * made["height"]
    assert made["usermeta"] == {"ratio": 2, "names": 0}
    assert spec(chart())["usermeta"] == {"ratio": None, "names": 0}
    image, *_ = made["layer"]
    assert image["data"]["values"][0]["url"].startswith("data:image/jpeg;base64,")
    (tip,) = (
        row for layer in made["layer"] for row in layer["data"]["values"] if row.get("shape", "").startswith("M0,0")
    )
    assert (tip["x"], tip["y"]) == (3, 1)


def test_axes_end_beyond_their_values_and_name_powers():
    axis = Axis("y", "log")
    low, high = axis.ends([[1e-7, 0.0, 2.0, np.nan]])
    assert low < 1e-7 < 2 < high
    assert axis.channel("y", (low, high))["axis"]["values"][:2] == [1e-7, 1e-6]
    assert axis.channel("y", (0.7, 30.0))["axis"]["values"] == [1, 2, 5, 10, 20]
    named = Axis("", named=((0.0, 'a "b"'), (1.0, "two,\nlines"))).channel("x", (0, 1))["axis"]
    assert named["labelExpr"] == '[["a \\"b\\""], ["two,", "lines"]][indexof([0.0, 1.0], datum.value)]'
    assert Axis("y").ends([[]]) == (0.0, 1.0)
    assert log_range([[np.nan, -1.0]]) == (0.1, 100.0)
    assert label_keys(["one"]) == ()
    assert [key.name for key in label_keys(["one", "two", "one"])] == ["one", "two"]


@pytest.mark.parametrize("x", [Axis("x"), Axis("x", "log"), Axis("x", "stretched"), Axis("x", named=((1.0, "one"),))])
def test_vega_takes_every_kind_of_mark_as_it_is(x):
    """A wrong name or value would be dropped with a warning, or refused."""
    bars = Bars(np.array([0.5, 0.5]), np.array([2.0, 2.0]), 4.0)
    marks = [Mark([1, 2], [1, 2], RED, f"n{i}", symbol=s, words=["a", "b"]) for i, s in enumerate(SHAPES)]
    marks += [Mark([1, 2], [1, 2], RED, line=line, bars=bars) for line in ("solid", "dash", "dashdot", "dot")]
    made = spec(chart(*marks, Mark([1, 2, 2], [1, 1, 2], BLUE, fill=True), x=x))
    compiled = json.dumps(vl_convert.vegalite_to_vega(made))
    assert compiled.count('"type": "symbol"') == 1
    for kind in ("rect", "rule", "text", "line"):
        assert f'"type": "{kind}"' in compiled


def test_names_are_plain_text_for_vega():
    evil = "</script><b>$x_1$ & $y"
    made = chart(Mark([1], [1], RED, evil, symbol="●", words=[evil], hover=[f"{evil}\nline"]))
    (row,) = rows_of(made, "text")
    assert row["text"] == evil
    assert "<" not in charts.embedded([made])["figures"]


def test_files_are_drawn_and_are_the_same_every_time():
    made = [chart(Mark([1, 2, 3], [1, 9, 1], c, f"n{i}", line="solid"), height=300) for i, c in enumerate([RED, BLUE])]
    content = png(made)
    assert png(made) == content
    with Image.open(io.BytesIO(content)) as drawn:
        picture = np.asarray(drawn.convert("RGB")).astype(int)
    ink = {
        colour: np.nonzero((np.abs(picture - rgb(colour)).max(axis=-1) < 30).any(axis=0))[0] for colour in (RED, BLUE)
    }
    # Beside each other.
    assert ink[RED].size > 100
    assert ink[BLUE].size > 100
    assert ink[RED].max() < ink[BLUE].min()


def test_vega_is_made_once_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(charts, "user_cache", lambda: tmp_path / "cache")
    monkeypatch.setattr(charts, "_converter", lambda: FakeConverter)
    charts.packed_vega.cache_clear()
    first = charts.packed_vega()
    assert zlib.decompress(base64.b64decode(first)) == b"script 1"
    charts.packed_vega.cache_clear()
    assert charts.packed_vega() == first
    # A damaged file is made again.
    (kept,) = (tmp_path / "cache").iterdir()
    kept.write_bytes(kept.read_bytes()[:-3])
    charts.packed_vega.cache_clear()
    assert zlib.decompress(base64.b64decode(charts.packed_vega())) == b"script 2"
    # A cache that cannot be written costs time alone.
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(charts, "user_cache", lambda: tmp_path / "file" / "cache")
    charts.packed_vega.cache_clear()
    assert zlib.decompress(base64.b64decode(charts.packed_vega())) == b"script 3"
    charts.packed_vega.cache_clear()


class FakeConverter:
    """Counts how often Vega is made."""

    made = 0

    @classmethod
    def javascript_bundle(cls, snippet):
        assert "vegaEmbed" in snippet
        cls.made += 1
        return f"script {cls.made}"


def test_frames_are_drawn_in_their_own_pixels():
    frame = np.zeros((40, 60), np.float32)
    frame[10, 20] = 1.0
    canvas = pixels.Canvas(frame, (15.0, 25.0, 5.0, 15.0), 100)
    rows, columns = np.nonzero(canvas.pixels[..., 0])
    # Pixel (20, 10) covers 20..21 and 10..11, ten times as large.
    assert (columns.min(), columns.max() + 1, rows.min(), rows.max() + 1) == (50, 60, 50, 60)
    canvas.cross((20.5, 10.5), RED, "#ffffff", 9)
    y, x = np.nonzero((canvas.pixels == rgb(RED)).all(axis=-1))
    assert (x.mean(), y.mean()) == pytest.approx((54.5, 54.5), abs=1)
    # Nothing to see, but nothing to fail at either.
    canvas.arrow(np.array([[0.0, np.nan], [1.0, 1.0]]), RED, 1)
    canvas.line(np.array([[-1e9, 3.0], [1e9, 4.0], [3.0, 1e9]]), RED, 1, dashed=False)


def test_pictures_are_embedded_small():
    picture = np.zeros((400, 600, 3), np.uint8)
    picture[..., 0] = 200
    address = pixels.data_address(picture, 300)
    assert address.startswith("data:image/avif;base64,")
    with Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))) as found:
        assert found.size == (450, 300)
        assert np.abs(np.asarray(found.convert("RGB")).astype(int) - picture[0, 0]).max() < 12


def test_figures_have_the_fonts_of_their_own_folder(monkeypatch):
    told = []
    monkeypatch.setitem(sys.modules, "vl_convert", SimpleNamespace(register_font_directory=told.append))
    charts._converter.__wrapped__()
    assert told == [str(pixels.fonts())]
