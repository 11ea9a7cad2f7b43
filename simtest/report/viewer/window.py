"""Draws the 3D view in a process of its own: VTK takes the whole process with it where there is no way to draw.

python -m simtest.report.viewer.window CONTENT.npz [SCREENSHOT.png]
"""

import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.pages.style import LIGHT, colours
from simtest.report.scene3d import CAMERA, TRUE, TRUE_BASE, Content, curvature_limit, estimators
from simtest.runtime.files import write_atomically

OFF_SCREEN = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")
"""VTK's ways to draw without a display: libegl1, libosmesa6."""

TIMEOUT_S = 180
SIZE = (1280, 800)
PANEL = 0.26
"""Share of the window's width for the legend, beside the scene."""

INK, TRUE_INK, BASE_INK = "#3a4048", "#C9A800", "#8A7A2E"
"""Colours of the camera and of the true normals."""

PLAIN = {"ambient": 0.55, "diffuse": 0.5}
MATT = {"ambient": 0.5, "diffuse": 0.5}
ROUGH = {"ambient": 0.35, "diffuse": 0.55, "specular": 0.5, "specular_power": 40.0}
"""Shading: of curvature, of colour, and of a relief, which shows by its glints."""

CURVATURE = "curvature (1/mm): principal one\nof larger size, of the base,\nconvex to the camera positive"

ZOOM = 1.3
"""Factor by which the scene is larger than VTK shows it."""

DONE = "simtest view: drawn"


def check_target(path: Path | None) -> None:
    """Raise `InputError` where it is plain, before anything is rendered, that there can be no PNG or no window."""
    if path is None:
        if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise InputError("no display (DISPLAY is not set); --screenshot FILE draws without one")
        return
    if path.suffix.lower() != ".png":
        raise InputError(f"--screenshot {path}: suffix {path.suffix!r}; must be .png")


def save_screenshot(content: Content, path: Path) -> None:
    """Draw to a PNG without a display.

    Raises `InputError` if the suffix is not .png, the file cannot be written, or this machine has no way to draw
    off-screen.
    """
    check_target(path)
    said = ""
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / "content.npz"
        picture = Path(folder) / "view.png"
        content.save(stored)
        for window in OFF_SCREEN:
            done, said = _draw([str(stored), str(picture)], {"VTK_DEFAULT_OPENGL_WINDOW": window}, TIMEOUT_S)
            if done and picture.is_file():
                write_atomically(path, functools.partial(shutil.copyfile, picture))
                return
    raise InputError(
        "--screenshot: nothing here draws without a display; install libegl1 (with libgl1-mesa-dri) or libosmesa6"
        f" ({said})"
    )


def show(content: Content) -> None:
    """Open a window and wait until it is closed; raises `InputError` if none can be opened."""
    check_target(None)
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / "content.npz"
        content.save(stored)
        done, said = _draw([str(stored)], {}, None)
    if not done:
        raise InputError(f"no window could be opened ({said}); --screenshot FILE draws without a display")


def _draw(arguments: list[str], environment: dict[str, str], timeout: float | None) -> tuple[bool, str]:
    """Run the drawing process; returns whether it ended well, and the last line that it wrote."""
    # -P: no file of the current folder may stand in for a package.
    command = [sys.executable, "-P", "-m", "simtest.report.viewer.window", *arguments]
    # The child finds the same simtest as this process, wherever that was started.
    here = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    surroundings = {**os.environ, **environment, "PYTHONPATH": path}
    try:
        child = subprocess.run(command, capture_output=True, text=True, env=surroundings, timeout=timeout)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {timeout} s"
    lines = (child.stderr + child.stdout).strip().splitlines()
    said = lines[-1] if lines else f"exit code {child.returncode}"
    return child.returncode == 0 and DONE in child.stdout, said


def _plot(content: Content, screenshot: str | None) -> None:
    """Draw in this process: the scene, and beside it the legend, so that none covers the other."""
    import numpy as np
    import pyvista

    plotter = pyvista.Plotter(
        off_screen=screenshot is not None, window_size=SIZE, shape=(1, 2), col_weights=[1 - PANEL, PANEL], border=False
    )
    plotter.set_background("white", all_renderers=True)
    plotter.subplot(0, 0)
    faces = np.column_stack([np.full(len(content.faces), 3), content.faces]).ravel()
    surface = pyvista.PolyData(content.vertices, faces)
    # The normals of the relief shade the surface; without one, VTK's own.
    rough, coloured = len(content.normal) > 0, len(content.colour) > 0
    if rough:
        surface.point_data.active_normals = content.normal
    light = ROUGH if rough else PLAIN
    if coloured:
        surface["colour"] = np.round(255 * content.colour).astype(np.uint8)
        light = light if rough else MATT
        actor = plotter.add_mesh(surface, scalars="colour", rgb=True, smooth_shading=not rough, **light)
    else:
        actor = _add_curvature(plotter, surface, content, light, rough)
    if rough:
        actor.prop.interpolation = "Phong"
    legend = _add_lines(plotter, content)
    _move_viewer(plotter, content)
    _add_legend(plotter, legend, None if coloured else actor.mapper)
    if screenshot is None:
        plotter.show(title="simtest view")
    else:
        plotter.screenshot(screenshot)
    plotter.close()


def _add_curvature(plotter: Any, surface: Any, content: Content, light: dict[str, float], rough: bool) -> Any:
    """Add the surface coloured by curvature; return its actor."""
    surface["curvature"] = content.curvature
    limit = curvature_limit(content.curvature)
    return plotter.add_mesh(
        surface, scalars="curvature", cmap="RdBu_r", clim=(-limit, limit), nan_color="grey", smooth_shading=not rough,
        show_scalar_bar=False, **light,
    )  # fmt: skip


def _add_lines(plotter: Any, content: Content) -> list[tuple[str, str]]:
    """Add camera, lights and normals; return their names and colours."""
    import numpy as np
    import pyvista

    names = estimators(content)
    palette = {CAMERA: INK, TRUE: TRUE_INK, TRUE_BASE: BASE_INK, **colours(names)}
    # The shorter lines are the wider ones, so that all show where they lie on each other.
    widths = {CAMERA: 2, TRUE: 3, TRUE_BASE: 3, **{name: 5 + 2 * i for i, name in enumerate(names)}}
    legend = []
    for name, colour in palette.items():
        own = content.names == name
        if own.any():
            points = np.stack([content.starts[own], content.ends[own]], axis=1).reshape(-1, 3)
            plotter.add_mesh(pyvista.line_segments_from_points(points), color=colour, line_width=widths[name])
            legend.append((name, colour))
    if len(content.lights):
        plotter.add_mesh(pyvista.PolyData(content.lights), color=LIGHT, point_size=14, render_points_as_spheres=True)
        legend.insert(1, ("light", LIGHT))
    return legend


def _add_legend(plotter: Any, legend: list[tuple[str, str]], mapper: Any) -> None:
    """Write the names in a column beside the scene, and the colours of curvature below them."""
    plotter.subplot(0, 1)
    top = 0.93
    for name, colour in legend:
        plotter.add_text("===", position=(0.02, top), viewport=True, font_size=11, color=colour)
        plotter.add_text(name, position=(0.2, top), viewport=True, font_size=10, color="black")
        top -= 0.055
    if mapper is not None:
        plotter.add_scalar_bar(
            mapper=mapper, title="", color="black", vertical=True, fmt="%.3g", n_labels=5,
            title_font_size=16, label_font_size=14, position_x=0.05, position_y=0.06, width=0.25, height=0.4,
        )  # fmt: skip
        plotter.add_text(CURVATURE, position=(0.02, 0.49), viewport=True, font_size=8, color="black")


def _move_viewer(plotter: object, content: Content) -> None:
    """Look from behind the camera and above it, at all that is shown."""
    import numpy as np

    middle = np.median(content.vertices, axis=0)
    size = float(np.linalg.norm(middle))
    viewer, target = (1.2 * size, -1.0 * size, -1.6 * size), (0.55 * middle).tolist()
    plotter.camera_position = [viewer, target, (0.0, -1.0, 0.0)]  # type: ignore[attr-defined]
    plotter.reset_camera()  # type: ignore[attr-defined]
    plotter.camera.zoom(ZOOM)  # type: ignore[attr-defined]
    plotter.reset_camera_clipping_range()  # type: ignore[attr-defined]


def main() -> None:
    """Draw what the arguments name."""
    _plot(Content.load(Path(sys.argv[1])), sys.argv[2] if len(sys.argv) > 2 else None)
    print(DONE)


if __name__ == "__main__":
    main()
