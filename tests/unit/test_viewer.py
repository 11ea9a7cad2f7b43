"""The 3D view: what it is made of, and a picture of it where this machine can draw without a display."""

import base64
import io
import re

import numpy as np
import pytest
import trimesh

from simtest.cli.main import main
from simtest.errors import InputError
from simtest.report import viewer
from simtest.report.scene3d import curvature_limit, framed
from simtest.report.viewer import Content, make_content, save_screenshot, show, window, write_scene_page
from simtest.report.viewer.scene_page import errors_deg
from simtest.spec import load_scene

SMALL = {"camera.width": 120, "camera.height": 120, "camera.fx": 120.0, "camera.fy": 120.0}


@pytest.fixture(scope="module")
def content():
    return make_content(load_scene("sphere", {**SMALL, "surface.radius_mm": 5.0, "surface.tilt_deg": 0.0}))


@pytest.mark.render
def test_content_is_the_scene(content):
    np.testing.assert_allclose(content.curvature, 0.2, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(content.vertices - [0, 0, 15.0], axis=1), 5.0, atol=1e-4)
    assert content.faces.max() < len(content.vertices)
    normals = {}
    for name, start, end in zip(content.names, content.starts, content.ends, strict=True):
        normals.setdefault(name, []).append((end - start) / np.linalg.norm(end - start))
    assert set(normals) == {"camera", "true normal", "circle_pose", "brightest_point", "cone_axis", "curved"}
    assert len(normals["camera"]) == 8
    assert len(normals["true normal"]) == 1
    assert float(normals["cone_axis"][0] @ normals["true normal"][0]) > 0.99999


@pytest.mark.render
def test_content_survives_its_file(content, tmp_path):
    content.save(tmp_path / "content.npz")
    again = Content.load(tmp_path / "content.npz")
    np.testing.assert_array_equal(again.vertices, content.vertices)
    assert list(again.names) == list(content.names)


@pytest.mark.render
def test_the_page_of_a_scene_is_one_small_file(content, tmp_path):
    write_scene_page(content, tmp_path / "scene.html", "sphere")
    page = (tmp_path / "scene.html").read_text("utf-8")
    assert len(page) < 3_000_000
    assert "true normal" in page
    frame, parts = framed(content, "lit")
    assert frame.startswith("<!DOCTYPE html>") or "<html" in frame
    lit, curved, *lines = parts
    assert (lit.name, lit.shown) == ("surface: lit", True)
    assert (curved.name, curved.shown) == ("surface: curvature from −0.28 (blue) to 0.28 (red)", False)
    assert [part.name for part in lines] == [
        "field of view", "true normal", "cone_axis", "circle_pose", "brightest_point", "curved", "camera", "light",
    ]  # fmt: skip
    # The sphere's one curvature is not the end of the colours.
    assert curvature_limit(content.curvature) == pytest.approx(0.2 * 1.4, rel=1e-3)
    errors = errors_deg(content)
    assert max(errors["cone_axis"]) < 0.1
    assert min(errors["circle_pose"]) > 10
    with pytest.raises(InputError, match=r"must be \.html"):
        write_scene_page(content, tmp_path / "scene.png", "sphere")
    with pytest.raises(OSError, match="No such file"):
        write_scene_page(content, tmp_path / "nowhere" / "scene.html", "sphere")


@pytest.mark.render
def test_the_frame_of_a_page_is_glb_that_another_reader_understands(content):
    frame, parts = framed(content, "lit")
    encoded = max(re.findall(r"[A-Za-z0-9+/]{64,}={0,2}", frame), key=len)
    glb = base64.b64decode(encoded)
    scene = trimesh.load_scene(io.BytesIO(glb), file_type="glb")
    meshes = {name: scene.geometry[scene.graph[name][1]] for name in scene.graph.nodes_geometry}
    assert set(meshes) == {part.node for part in parts}
    assert len(glb) % 4 == 0
    lit = meshes["part0"]
    np.testing.assert_allclose(lit.triangles, content.vertices[content.faces], rtol=1e-6)
    colours = np.rint(255 * content.lit).astype(np.uint8)
    shown = trimesh.Trimesh(content.vertices, content.faces, vertex_colors=colours, process=False)
    np.testing.assert_array_equal(lit.visual.face_colors, shown.visual.face_colors)
    # A rod from each start to each end, and round balls whose triangles face outwards, as viewers draw no others.
    for part in parts[2:-2]:
        own = content.names == {"field of view": "camera"}.get(part.name, part.name)
        rods = meshes[part.node].vertices.reshape(own.sum(), 2, 6, 3).mean(axis=2)
        np.testing.assert_allclose(rods, np.stack([content.starts[own], content.ends[own]], axis=1), atol=1e-5)
    for part, centre in zip(parts[-2:], (np.zeros(3), content.lights[0]), strict=True):
        ball = meshes[part.node]
        np.testing.assert_allclose(ball.bounds.mean(axis=0), centre, atol=1e-5)
        radius = np.linalg.norm(ball.vertices - centre, axis=1)
        np.testing.assert_allclose(radius, radius[0], rtol=1e-4)
        assert 0.85 < ball.volume / (4 / 3 * np.pi * radius[0] ** 3) < 1
    # The viewer looks at the middle of all.
    pose = scene.camera_transform
    towards = scene.bounds.mean(axis=0) - pose[:3, 3]
    np.testing.assert_allclose(-pose[:3, 2], towards / np.linalg.norm(towards), atol=1e-5)


@pytest.mark.render
def test_a_lit_surface_has_its_highlight(content):
    assert content.lit.shape == content.vertices.shape
    assert (content.lit >= 0).all()
    assert (content.lit <= 1).all()
    is_true = content.names == "true normal"
    nearest = np.linalg.norm(content.vertices - content.starts[is_true][0], axis=1).argmin()
    assert content.lit[nearest].min() > 0.95
    assert np.median(content.lit[:, 0]) > np.median(content.lit[:, 2])


@pytest.mark.render
def test_where_nothing_draws_it_says_what_to_install(content, tmp_path, monkeypatch):
    monkeypatch.setattr(window, "_draw", lambda *_: (False, "exit code -11"))
    with pytest.raises(InputError, match=r"libegl1 .* or libosmesa6"):
        save_screenshot(content, tmp_path / "view.png")
    with pytest.raises(InputError, match=r"must be \.png"):
        save_screenshot(content, tmp_path / "view.jpg")


@pytest.fixture
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(window.sys, "platform", "linux")


@pytest.mark.render
def test_a_window_without_a_display_is_refused(content, no_display):
    with pytest.raises(InputError, match="--screenshot"):
        show(content)


@pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")
@pytest.mark.parametrize("target", [["--screenshot", "nowhere/view.png"], ["--screenshot", "view.jpg"], []])
def test_the_command_refuses_before_it_renders(monkeypatch, tmp_path, capsys, no_display, target):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(viewer, "make_content", lambda *_: pytest.fail("rendered"))
    monkeypatch.setattr("sys.argv", ["simtest", "view", "plane", *target])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "--screenshot" in capsys.readouterr().err
