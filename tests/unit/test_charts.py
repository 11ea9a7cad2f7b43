"""Charts: described once, drawn alike in pages and in files; and the bundle that draws them in pages."""

import base64
import hashlib
import io
import json
import re
import zlib

import numpy as np
import pytest
from PIL import Image

from simtest.pages import chart_png, chart_web, pixels
from simtest.pages.axes import Axis, log_range
from simtest.pages.chart import NOTHING, Bars, Chart, Mark, Panel, label_keys
from simtest.pages.style import rgb, symbols

RED, BLUE = "#D03030", "#0072B2"
DOT = symbols(["a"])["a"]


def chart(*marks, **more):
    return Chart("key", "Title", (Panel(Axis("x"), Axis("y", "log"), marks),), **more)


def inked(picture, colour):
    return int((np.abs(picture.astype(int) - rgb(colour)).max(axis=-1) < 8).sum())


def drawn(*charts):
    return chart_png.draw(charts)


def test_the_bundle_is_the_published_one():
    packed = chart_web.BUNDLE.read_bytes()
    source = zlib.decompress(packed)
    told = chart_web.BUNDLE.with_name("README.md").read_text(encoding="utf-8")
    assert hashlib.sha256(packed).hexdigest() in told
    assert hashlib.sha256(source).hexdigest() in told
    (version,) = set(re.findall(r"plotly\.js-gl3d-dist-min` ([\d.]+)", told))
    assert f"plotly.js (gl3d - minified) v{version}".encode() in source[:200]
    assert (
        b"Permission is hereby granted, free of charge"
        in chart_web.BUNDLE.with_name("plotly-gl3d.LICENSE").read_bytes()
    )
    assert base64.b64decode(chart_web.packed_plotly()) == packed


def test_a_name_has_one_entry_of_its_first_line_or_symbol():
    bars = Mark([1.0], [1.0], RED, "a", bars=Bars(np.array([0.5]), np.array([2.0])))
    law = Mark([1, 2], [1, 2], RED, "a", listed=False, line="dash")
    points = Mark([1, 2], [1, 2], RED, "a", symbol=DOT)
    made = chart(
        bars, law, points, Mark([1, 2], [1, 2], BLUE, "b", line="solid"), Mark(NOTHING, NOTHING, RED, "c", line="dash")
    )
    assert [mark.name for mark in made.entries] == ["a", "b", "c"]
    assert made.entries[0] is points
    traces = chart_web.figure(made)["data"]
    assert [trace["showlegend"] for trace in traces] == [False, False, True, True, True]
    assert [trace["legendgroup"] for trace in traces] == ["a", "a", "a", "b", "c"]


def test_both_media_leave_out_what_a_log_axis_cannot_show():
    made = chart(Mark([1, 2, 3], [0.0, 1.0, 10.0], RED, symbol=DOT, size=12, line="solid", width=3))
    assert chart_web.figure(made)["data"][0]["y"] == [None, 1.0, 10.0]
    low, high = chart_web.figure(made)["layout"]["yaxis"]["range"]
    assert low < 0
    assert high > 1
    picture, _ = drawn(made)
    assert inked(picture, RED) > 200


def test_texts_are_escaped_in_pages_and_plain_in_files():
    evil = "<b>$x_1$ & $y"
    made = chart(Mark([1], [1], RED, evil, symbol=DOT, words=[evil], hover=[f"{evil}\nline"]))
    text = json.dumps(chart_web.figure(made))
    assert "<b>$" not in text.replace("<b>&lt;", "")
    assert "&lt;b&gt;$x_1$ &amp; $y" in text
    drawn(made)


def test_a_hover_may_hold_the_points_coordinates():
    axis = Axis("x", "stretched")
    mark = Mark([-1.0, 1.0], [1.0, 2.0], RED, line="dash", hover="law {x}: {y}")
    (trace,) = chart_web.figure(Chart("k", "t", (Panel(axis, Axis("y"), (mark,)),)))["data"]
    assert trace["hovertemplate"] == "law %{customdata:.3g}: %{y:.3g}<extra></extra>"
    assert trace["customdata"] == [-1.0, 1.0]
    np.testing.assert_allclose(trace["x"], axis.to_axis([-1.0, 1.0]), rtol=1e-4)


def test_panels_share_x_and_the_height():
    lower = Panel(
        Axis("x"), Axis("failures", limits=(0, 1), named=()), (Mark([1, 2], [0.5, 0.5], RED, words="ab"),), 0.25
    )
    upper = Panel(Axis("x"), Axis("y"), (Mark([1, 2], [1, 2], BLUE, line="solid"),))
    made = Chart("key", "Title", (upper, lower))
    layout = chart_web.figure(made)["layout"]
    assert layout["xaxis"]["anchor"] == "y2"
    assert layout["yaxis"]["domain"][0] > layout["yaxis2"]["domain"][1]
    assert layout["yaxis2"]["tickvals"] == []
    picture, _ = drawn(made)
    rows = np.flatnonzero((np.abs(picture.astype(int) - rgb(RED)).max(axis=-1) < 60).any(axis=1))
    assert rows.min() > picture.shape[0] / 2


def test_several_charts_are_one_picture_and_its_parts():
    made = [
        chart(Mark([1, 2], [1, 2], colour, f"n{i}", line="solid"), height=300)
        for i, colour in enumerate([RED, BLUE] * 2)
    ]
    whole, parts = drawn(*made)
    assert len(parts) == 4
    assert whole.shape[0] == pytest.approx(2 * parts[0].shape[0], abs=2)
    assert whole.shape[1] == pytest.approx(3 * parts[0].shape[1], abs=3)
    for part, colour, other in zip(parts, [RED, BLUE] * 2, [BLUE, RED] * 2, strict=True):
        assert inked(part, colour) > 100
        assert inked(part, other) == 0


def test_axes_end_beyond_their_values_and_name_powers():
    axis = Axis("y", "log")
    low, high = axis.ends([[1e-7, 0.0, 2.0, np.nan]])
    assert low < 1e-7 < 2 < high
    texts = [text for _, text in axis.ticks(low, high)]
    assert {"10⁻⁷", "0.001", "1"} <= set(texts)
    assert [text for _, text in axis.ticks(0.7, 30.0)] == ["1", "2", "5", "10", "20"]
    assert axis.minor_ticks(0.7, 3.0) == pytest.approx([0.7, 0.8, 0.9, 2, 3])
    assert Axis("y").ends([[]]) == (0.0, 1.0)
    assert log_range([[np.nan, -1.0]]) == (0.1, 100.0)
    assert label_keys(["one"]) == ()
    assert [key.name for key in label_keys(["one", "two", "one"])] == ["one", "two"]


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
