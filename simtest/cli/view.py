"""`simtest view`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.options import AsJson, SceneName, Settings, Variant, named_path


def view(
    scene: SceneName,
    /,
    *,
    screenshot: Annotated[
        Path | None,
        Parameter(help="PNG to draw to, without a display, instead of opening a window.", converter=named_path),
    ] = None,
    page: Annotated[
        Path | None,
        Parameter(help="HTML file with the scene to turn and zoom in a browser, offline.", converter=named_path),
    ] = None,
    settings: Settings = None,
    variant: Variant = None,
    as_json: AsJson = False,
) -> None:
    """Show a scene in 3D: surface coloured by curvature, camera, lights, true and estimated normals."""
    from simtest.cli.printing import print_files
    from simtest.report.viewer import (
        check_page,
        check_target,
        make_content,
        save_screenshot,
        show,
        write_scene_page,
    )
    from simtest.report.viewer.content import PAGE_GRID
    from simtest.runtime.locks import exclusive_file
    from simtest.spec import load_scene, parse_settings

    described = load_scene(scene, parse_settings(settings or []))
    if page is not None:
        check_page(page)
    if screenshot is not None or page is None:
        check_target(screenshot)
    if screenshot is None and page is None:
        show(make_content(described, variant))
        return
    if page is not None:
        with exclusive_file(page, "--page"):
            write_scene_page(make_content(described, variant, PAGE_GRID), page, described.name)
    if screenshot is not None:
        with exclusive_file(screenshot, "--screenshot"):
            save_screenshot(make_content(described, variant), screenshot)
    print_files([file for file in (page, screenshot) if file is not None], as_json)
