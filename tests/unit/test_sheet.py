"""Drawing on a sheet of pixels: where ink falls, and how much."""

import numpy as np
import pytest

from simtest.pages.sheet import Sheet, text_width
from simtest.pages.style import rgb

BLACK, RED = "#000000", "#D03030"


def ink(sheet):
    """Darkness of each pixel in 0..1."""
    return 1 - sheet.pixels.mean(axis=-1) / 255


def middle(sheet):
    """Centre of the ink, px."""
    dark = ink(sheet)
    rows, columns = np.indices(dark.shape) + 0.5
    return float((columns * dark).sum() / dark.sum()), float((rows * dark).sum() / dark.sum())


def cropped(sheet):
    rows, columns = np.nonzero(ink(sheet))
    return sheet.pixels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


@pytest.mark.parametrize("width", [1.4, 2.0, 2.4, 3.6, 5.0, 8.0])
@pytest.mark.parametrize("ends", [[(5, 30), (95, 30)], [(5, 12), (95, 48)], [(5.3, 30.6), (95.2, 31.1)]])
def test_lines_have_their_width_and_place(width, ends):
    sheet = Sheet.white(100, 60)
    sheet.line(ends, BLACK, width)
    along = np.subtract(*ends[::-1])
    across = ink(sheet)[:, 40:60].sum(axis=0).mean() * abs(along[0]) / np.hypot(*along)
    # Half a px in width, less across the line; its ends are whole px.
    assert across == pytest.approx(width, abs=0.5)
    x, y = np.mean(ends, axis=0)
    assert middle(sheet)[0] == pytest.approx(x, abs=0.6)
    assert middle(sheet)[1] == pytest.approx(y, abs=0.1)


def test_a_line_has_gaps_where_points_are_missing_and_dashes_where_told():
    sheet = Sheet.white(100, 20)
    sheet.line([(5, 10), (40, 10), (np.nan, np.nan), (60, 10), (95, 10), (np.nan, 3), (50, 2)], BLACK, 2)
    dark = ink(sheet).sum(axis=0) > 0.5
    assert dark[10:38].all()
    assert dark[62:92].all()
    assert not dark[43:58].any()
    shares = {}
    for dash in ("solid", "dash", "dashdot", "dot"):
        sheet = Sheet.white(400, 20)
        sheet.line([(5, 10), (200, 10), (395, 10)], BLACK, 3, dash)
        shares[dash] = (ink(sheet).sum(axis=0) > 1.5).mean()
    assert shares["solid"] > 0.95
    assert shares["solid"] > shares["dash"] > shares["dot"] > 0.2
    assert shares["dash"] == pytest.approx(3.7 / 5.3, abs=0.12)


def test_points_far_away_and_no_points_at_all_do_no_harm():
    sheet = Sheet.white(50, 50)
    sheet.line([(-1e12, 25), (1e12, 25)], BLACK, 3)
    assert (ink(sheet)[25] > 0.9).all()
    for points in (np.empty((0, 2)), [(1, 1)], [(np.nan, 1), (2, np.nan)]):
        empty = Sheet.white(50, 50)
        for width in (1, 4):
            empty.line(points, BLACK, width)
            empty.line(points, BLACK, width, "dash")
        assert not ink(empty).any()
    # A line of no length has no dashes.
    empty.line([(1, 1), (1, 1)], BLACK, 1, "dash")
    empty.markers([(np.nan, 3)], "o", 8, BLACK, 1)
    assert not ink(empty).any()


@pytest.mark.parametrize("symbol", ["o", "s", "^", "v", "D", "P", "X", "*", "+", "x", "_", "|", "."])
def test_markers_lie_on_their_points(symbol):
    sheet = Sheet.white(60, 60)
    sheet.markers([(30.5, 28.5)], symbol, 20, RED, 2)
    rows, columns = np.nonzero(ink(sheet) > 0.3)
    assert (columns.min() + columns.max() + 1) / 2 == pytest.approx(30.5, abs=1)
    assert (rows.min() + rows.max() + 1) / 2 == pytest.approx(28.5, abs=2 if symbol == "*" else 1)
    size = max(np.ptp(rows), np.ptp(columns)) + 1
    # A diamond is a square of that size on its corner; a point is half a circle's size.
    wanted = {"D": 20 * 2**0.5 + 2, ".": 12}.get(symbol, 22)
    assert size == pytest.approx(wanted, abs=3)


def test_parts_share_pixels_and_hide_what_lies_beyond():
    sheet = Sheet.white(100, 60)
    part = sheet.part(20, 10, 60, 40)
    assert part.pixels.shape == (30, 40, 3)
    part.line([(0, 25), (100, 25)], BLACK, 2)
    part.box(50, 30, 200, 200, RED)
    dark = ink(sheet)
    assert dark[25, 20:60].min() > 0.4
    assert not dark[:, :20].any()
    assert not dark[:, 60:].any()
    assert not dark[40:].any()
    assert (sheet.pixels[30:40, 50:60] == rgb(RED)).all()


@pytest.mark.parametrize("at", [10.0, 10.25, 10.5, 10.75, 11.5])
def test_boxes_keep_whole_widths_wherever_they_lie(at):
    sheet = Sheet.white(30, 30)
    sheet.box(at - 0.5, 5, at + 0.5, 8, BLACK)
    assert ink(sheet).sum() == pytest.approx(3)


def test_faint_ink_lies_on_what_is_there():
    sheet = Sheet.white(40, 40)
    with sheet.faint((10, 10, 30, 30), 0.4) as layer:
        layer.box(0, 0, 40, 40, BLACK)
    assert sheet.pixels[20, 20, 0] == pytest.approx(0.6 * 255, abs=1)
    assert (sheet.pixels[:10] == 255).all()


def test_texts_stand_where_they_are_told_to():
    for across, down in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        sheet = Sheet.white(300, 100)
        wide, high = sheet.text((150, 50), "Hxlpq", 20, across=across, down=down)
        rows, columns = np.nonzero(ink(sheet) > 0.2)
        left, top = 150 - across * wide, 50 - down * high
        assert left - 2 <= columns.min() <= columns.max() <= left + wide + 2
        assert top - 1 <= rows.min() <= rows.max() <= top + high + 1
        assert wide == pytest.approx(text_width("Hxlpq", 20), abs=2)
    upright, flat = Sheet.white(100, 300), Sheet.white(300, 100)
    upright.text((50, 150), "deg", 20, turn_deg=90)
    flat.text((150, 50), "deg", 20)
    np.testing.assert_array_equal(np.rot90(cropped(flat)), cropped(upright))


def test_texts_are_cut_at_the_edge_and_may_have_lines():
    sheet = Sheet.white(40, 40)
    sheet.text((0, 0), "mmm", 20)
    sheet.text((40, 40), "mmm", 20)
    assert 0 < (ink(sheet) > 0.5).sum() < 300
    one, two = Sheet.white(200, 100), Sheet.white(200, 100)
    assert two.text((100, 50), "of\n100", 16)[1] > 1.8 * one.text((100, 50), "of", 16)[1] * 0.9
    assert middle(two) == pytest.approx((100, 50), abs=4)


def test_triangles_leave_no_seam():
    sheet = Sheet.white(60, 60)
    corners = np.array([[(5, 5), (55, 7), (30, 52)], [(55, 7), (30, 52), (58, 55)]], float)
    sheet.triangles(corners, np.array([(10, 20, 30), (10, 20, 30)], np.uint8))
    x, y = np.mean([(55, 7), (30, 52)], axis=0).astype(int)
    assert (sheet.pixels[y - 5 : y + 5, x - 3 : x + 3] == (10, 20, 30)).all()
