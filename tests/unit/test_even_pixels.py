"""Which pixels need samples, and the mean of those that need none."""

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtest.geometry.camera import Camera
from simtest.rendering import Session, adaptive
from simtest.rendering.adaptive import MeshEdges, Strokes, edges_of
from simtest.rendering.rays import in_tiles
from simtest.spec import scene_from_dict
from simtest.surfaces import TriangleMesh
from tests.marked import marked

HEIGHT, WIDTH = 24, 32
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
INNER = np.s_[2:-2, 2:-2]
COEFFICIENTS = st.lists(st.floats(-1, 1), min_size=10, max_size=10)
POWERS = [(i, j) for i in range(4) for j in range(4 - i)]


def moment(power, centre):
    """Mean of t^power over the pixel of a centre."""
    return ((centre + 0.5) ** (power + 1) - (centre - 0.5) ** (power + 1)) / (power + 1)


@given(COEFFICIENTS)
def test_the_mean_of_a_cubic_is_exact(coefficients):
    x, y = (X - 16) / 16, (Y - 12) / 16
    centres = sum(c * x**i * y**j for c, (i, j) in zip(coefficients, POWERS, strict=True))
    exact = sum(
        c * moment(i, X - 16) * moment(j, Y - 12) / 16 ** (i + j)
        for c, (i, j) in zip(coefficients, POWERS, strict=True)
    )
    mean = adaptive.mean_of_pixel(centres.astype(np.float32))
    np.testing.assert_allclose(mean[INNER], exact[INNER], atol=3e-6)


@given(st.floats(4, 28), st.floats(0.05, 1))
def test_a_step_is_uneven_wherever_it_lies_and_its_smooth_sides_are_not(place, height):
    centres = (1 + 0.01 * Y + height * (place < X)).astype(np.float32)
    found = adaptive.uneven(centres, centres)[INNER]
    columns = np.arange(2, WIDTH - 2)
    # The two pixels beside the step, one of which it may cross.
    assert found[:, np.abs(columns - place) < 1].all()
    assert not found[:, np.abs(columns - place) > 4].any()


@pytest.mark.parametrize("kink", [0.5, 2.0])
def test_a_kink_that_errs_more_than_allowed_is_uneven(kink):
    slope = 0.01
    centres = (1 + slope * X + kink * slope * np.maximum(X - 16, 0)).astype(np.float32)
    found = adaptive.uneven(centres, centres)
    error = kink * slope * (1 / 8 - 1 / 24)
    assert found[12, 16] == (error > adaptive.ALLOWED * slope * (1 + kink / 2))
    assert not found[INNER][:, :8].any()


def test_a_lobe_wider_than_a_few_pixels_is_even_and_a_narrow_one_is_not():
    def lobe(width):
        return np.exp(-((X - 15.7) ** 2 + (Y - 11.4) ** 2) / (2 * width**2)).astype(np.float32)

    assert adaptive.uneven(lobe(0.6), lobe(0.6))[11, 15]
    assert not adaptive.uneven(lobe(6.0), lobe(6.0))[INNER].any()


def test_pixels_are_chosen_at_the_border_of_the_surface_and_where_the_normal_turns_fast():
    flat = np.ones((HEIGHT, WIDTH), np.float32)
    still = [0 * flat, 0 * flat, 0 * flat]
    assert not adaptive.choose([flat], flat, still, 100 * flat, 0.1)[INNER].any()
    hole = flat.copy()
    hole[10, 10] = np.nan
    assert adaptive.choose([flat], hole, still, 100 * flat, 0.1)[8:13, 8:13].all()
    bent = [np.where(X > 15, np.float32(0.2), np.float32(0)).astype(np.float32), *still[1:]]
    assert adaptive.choose([flat], flat, bent, 100 * flat, 0.1)[:, 15:17].all()
    assert not adaptive.choose([flat], flat, bent, 100 * flat, 0.3)[INNER].any()
    assert adaptive.choose([flat], flat, still, flat, 0.1).all()


@given(st.integers(1, 13), st.integers(1, 13), st.integers(0, 2**32 - 1))
def test_tiles_hold_each_chosen_pixel_once(height, width, seed):
    chosen = np.random.default_rng(seed).random((height, width)) < 0.4
    numbers = in_tiles(chosen)
    assert sorted(numbers) == list(np.flatnonzero(chosen))


def test_edges_of_a_tetrahedron_and_of_a_lone_triangle():
    ends, sides = edges_of(np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [4, 5, 6]]))
    assert [tuple(end) for end in ends] == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (4, 5), (4, 6), (5, 6)]
    assert [set(map(int, side)) for side in sides[:6]] == [{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}]
    assert (sides[6:] == 4).all()


@given(st.lists(st.floats(-1.5, 1.5), min_size=4, max_size=4), st.floats(0.5, 3))
def test_a_stroke_marks_every_pixel_that_it_crosses_long(ends, depth):
    """All pixels of which it crosses more than the step between its points."""
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, 16.0, 12.0)
    points = np.array([[ends[0], ends[1], 1.0], [ends[2], ends[3], depth]])
    strokes = Strokes(camera, np.full((HEIGHT, WIDTH), np.nan, np.float32))
    strokes.draw(points, np.array([0, 0]))
    first, second = camera.project(points)
    fine = first + np.linspace(0, 1, 4001)[:, None] * (second - first)
    inside = fine[((fine >= 0) & (fine < [WIDTH, HEIGHT])).all(axis=1)].astype(int)
    counts = np.zeros((HEIGHT, WIDTH))
    np.add.at(counts, (inside[:, 1], inside[:, 0]), np.linalg.norm(second - first) / 4000)
    assert strokes.marked[counts > 0.51].all()
    crossed = np.zeros((HEIGHT, WIDTH), np.uint8)
    crossed[inside[:, 1], inside[:, 0]] = 1
    assert not strokes.marked[cv2.dilate(crossed, np.ones((3, 3), np.uint8)) == 0].any()


def test_what_lies_behind_the_surface_is_not_marked():
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, 16.0, 12.0)
    for depth, seen in ((5.0, False), (20.0, True)):
        strokes = Strokes(camera, np.full((HEIGHT, WIDTH), depth, np.float32))
        strokes.draw(np.array([[-1.0, 0, 10], [1, 0, 10]]), np.array([0, 0]))
        assert strokes.marked.any() == seen


# In the renderer -----------------------------------------------------------------------------------------------------


def scene(surface, lights=({"position_mm": [2.0, -1.5, 1.0]},), camera=None, **render):
    return scene_from_dict(
        {
            "surface": surface,
            "reflectance": {"type": "phong", "diffuse": 0.3},
            "camera": {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, **(camera or {})},
            "rig": {"lights": list(lights)},
            "render": {"samples_per_pixel": 4, **render},
        }
    )


@pytest.mark.render
def test_smooth_pixels_are_the_same_for_all_seeds_and_the_others_those_of_samples_everywhere():
    surface = {"type": "sphere", "radius_mm": 3.0}
    session = Session(scene(surface))

    def total(**render):
        session.update(scene(surface, **render))
        return session.radiance().total

    first, second, sampled = total(seed=1), total(seed=2), total(seed=1, adaptive=False)
    even = first == second
    assert 0.3 < even[INNER].mean() < 1
    np.testing.assert_array_equal(first[~even], sampled[~even])
    np.testing.assert_allclose(first[even], sampled[even], rtol=0.05)


@pytest.mark.render
@pytest.mark.parametrize("samples", [1, 2, 3])
def test_few_samples_stay_as_they_are(samples):
    surface = {"type": "plane"}
    session = Session(scene(surface, samples_per_pixel=samples))
    assert not adaptive.applies(session.scene)
    first = session.radiance().total.tobytes()
    session.update(scene(surface, samples_per_pixel=samples, adaptive=False))
    assert session.radiance().total.tobytes() == first


@pytest.mark.parametrize(
    "change",
    [
        {"render": {"samples_per_pixel": 4, "path_depth": 3}},
        {"rig": {"lights": [{"source": {"type": "disc", "radius_mm": 1.0}}]}},
        {"surface": {"type": "plane", "relief": {"bands": [{"slope_deg": 5.0, "wavelength_mm": 1.5}]}}},
        {"reflectance": {"type": "phong", "albedo": {"preset": "colon_mucosa"}}},
        {"render": {"samples_per_pixel": 4, "adaptive": False}},
    ],
    ids=["bounces", "disc", "relief", "albedo", "off"],
)
def test_what_may_be_finer_than_a_pixel_gets_all_samples(change):
    tables = {"surface": {"type": "plane"}, "render": {"samples_per_pixel": 4}}
    assert adaptive.applies(scene_from_dict(tables))
    assert not adaptive.applies(scene_from_dict(tables | change))


@pytest.mark.render
def test_outlines_sharp_edges_and_shadows_of_a_mesh_are_marked():
    """A square before a wall, the light aside: its rim is marked, and its shadow's; beyond the wall nothing is."""
    session = Session(scene({"type": "quadric", "k1_per_mm": 0.0, "k2_per_mm": 0.0}))
    wall = [[-40, -40, 20], [40, -40, 20], [-40, 40, 20], [40, 40, 20]]
    square = [[-2, -2, 10], [2, -2, 10], [-2, 2, 10], [2, 2, 10]]
    hidden = [[-2, -2, 30], [2, -2, 30], [-2, 2, 30], [2, 2, 30]]
    vertices = np.array([*wall, *square, *hidden], dtype=float)
    faces = np.concatenate([np.array([[0, 2, 1], [1, 2, 3]]) + start for start in (0, 4, 8)])
    camera = session.camera
    inside = np.abs((camera.pixel_centres() - [32, 24]) / 50 * 10).max(axis=-1) < 2
    depth = (np.where(inside, 10.0, 20.0) / camera.unproject(camera.pixel_centres())[..., 2]).astype(np.float32)

    def marks_of(lights, bent=False):
        normals = np.tile([0.0, 0.0, -1.0], (12, 1))
        normals[6] = [0.5, 0.0, -np.sqrt(0.75)] if bent else normals[6]
        mesh = TriangleMesh(vertices, faces, normals)
        made = session.mi.Mesh("m", 12, 6, has_vertex_normals=True)
        parameters = session.mi.traverse(made)
        for name, values, dtype in (("vertex_positions", vertices, np.float32), ("faces", faces, np.uint32)):
            parameters[name] = np.ascontiguousarray(values, dtype=dtype).ravel()
        parameters.update()
        parameters["vertex_normals"] = np.ascontiguousarray(mesh.normals, dtype=np.float32).ravel()
        parameters.update()
        edges = MeshEdges(session.mi.load_dict({"type": "scene", "m": made}), mesh)
        return edges.marks(camera, np.eye(4), lights, depth, 0.01 if bent else 0.1, 50.0)

    # Without a light the rim alone; where the normal turns along the diagonal, it too.
    rim, sharp = (marks_of(np.empty((0, 3)), bent) for bent in (False, True))
    assert rim[14, 22:42].all()
    assert not rim[16:32, 24:40].any()
    assert not rim[:, :20].any()
    assert sharp[16:32, 24:40].sum() > 12
    marks = marks_of(np.array([[5.0, 0.0, 0.0]]))
    # The rim of the square: 10 px from the centre.
    assert marks[14, 22:42].all()
    assert marks[14:34, 22].all()
    # Its shadow spans x from -9 to -1 mm and y from -4 to 4 mm on the wall, 2.5 px a mm; the square hides a part.
    column = 32 - round(9 * 2.5)
    assert marks[15:33, column - 1 : column + 1].any(axis=1).all()
    # Neither what lies within nor what the wall hides.
    assert not marks[16:32, 24:40].any()
    assert not marks[:10].any()
    assert not marks[:, 46:].any()


@pytest.mark.render
def test_progress_ends_at_its_total_and_rises():
    session, told = Session(scene({"type": "sphere", "radius_mm": 3.0})), []
    session.radiance(lambda done, total, what: told.append((done, total)))
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1][0] == told[-1][1] == 64 * 48 * 4


SHAPES = {
    "sphere": {"type": "sphere", "radius_mm": 6.0},
    "saddle": {"type": "quadric", "k1_per_mm": 0.06, "k2_per_mm": -0.04},
}


@pytest.mark.render
@pytest.mark.parametrize("name", marked(SHAPES, ci=["saddle"]))
def test_labels_need_no_second_trace(name):
    """Those from the hits of the radiance are, byte for byte, those of a trace of their own."""
    session = Session(scene(SHAPES[name]))
    labels = session.frame().labels
    session.update(scene(SHAPES[name], adaptive=False))
    traced = session.frame().labels
    for field in dataclasses.fields(labels):
        first, second = getattr(labels, field.name), getattr(traced, field.name)
        assert first is second is None or first.tobytes() == second.tobytes(), field.name
