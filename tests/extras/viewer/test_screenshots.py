"""Pictures of a scene without a display."""

import cv2
import numpy as np
import pytest
import test_viewer
from test_viewer import SMALL

from simtest.report.viewer import make_content, save_screenshot, window
from simtest.spec import load_scene

content = test_viewer.content


@pytest.mark.slow
@pytest.mark.render
def test_tissue_is_shown_in_its_colours_with_its_relief(content, tmp_path):
    assert content.normal.shape == content.colour.shape == (0, 3)
    relief = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]}
    changes = {"surface.relief": relief, "surface.tilt_deg": 0.0, "reflectance.albedo": {}}
    described = load_scene("sphere", {**SMALL, **changes})
    shown = make_content(described)
    assert shown.normal.shape == shown.colour.shape == shown.vertices.shape
    # Finer than of smooth scenes, and the curvature is the base's.
    assert len(shown.vertices) >= len(content.vertices)
    assert np.ptp(shown.curvature) < 1e-4
    # The normals are those of the relief, 4 deg steep along each of two directions, about those of the sphere.
    out = shown.vertices - [0.0, 0.0, shown.vertices[:, 2].min() + 10.0]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    turned = np.degrees(np.arccos(np.clip(np.sum(out * shown.normal, axis=1), -1, 1)))
    assert 4.5 < np.sqrt(np.mean(turned**2)) < 6.8
    # Mucosa is red before it is green and blue, and its vessels are darker.
    assert (shown.colour[:, 0] > shown.colour[:, 1]).all()
    assert np.ptp(shown.colour[:, 1]) > 0.1
    save_screenshot(shown, tmp_path / "view.png")
    picture = cv2.imread(str(tmp_path / "view.png")).astype(int)
    assert ((picture[..., 2] - picture[..., 0]) > 30).mean() > 0.003


@pytest.mark.render
def test_a_screenshot_needs_no_display(content, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    path = tmp_path / "view.png"
    save_screenshot(content, path)
    picture = cv2.imread(str(path))
    assert picture.shape[:2] == window.SIZE[::-1]
    # Convex is red, BGR; the background is white.
    red = (picture[..., 2].astype(int) - picture[..., 0] > 80).mean()
    assert red > 0.003
    assert list(picture[5, 5]) == [255, 255, 255]
