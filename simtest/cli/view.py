"""`simtest view`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.options import SceneName, Settings, Variant


def view(
    scene: SceneName,
    /,
    *,
    screenshot: Annotated[
        Path | None, Parameter(help="PNG to draw to, without a display, instead of opening a window.")
    ] = None,
    settings: Settings = None,
    variant: Variant = None,
) -> None:
    """Show a scene in 3D: surface coloured by curvature, camera, lights, true and estimated normals."""
    from simtest.report.viewer import check_target, make_content, save_screenshot, show
    from simtest.spec import load_scene, parse_settings

    described = load_scene(scene, parse_settings(settings or []))
    check_target(screenshot)
    content = make_content(described, variant)
    if screenshot is None:
        show(content)
    else:
        save_screenshot(content, screenshot)
        print(screenshot)
