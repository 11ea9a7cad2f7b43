"""`simtest camera`: show what a camera file means, or convert it to another program's format."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from simtest.cli.options import AsJson, named_path

if TYPE_CHECKING:
    from typing import Any

    from simtest.runtime.arrays import Array

camera = App(name="camera", help="Show what a camera file means, or convert it to another program's format.")

ViewRadius = Annotated[
    float | None,
    Parameter(help="Radius in px of the round view about the picture's centre, where the file states none."),
]


@camera.command
def show(file: Path, /, *, view_radius: ViewRadius = None, as_json: AsJson = False) -> None:
    """Show a camera file as it is understood: format, fields of view, and what the lens does at the border.

    Parameters
    ----------
    file : Path
        A camera file of any known format. FILE#ID names one camera of several.
    """
    from simtest.cli.printing import print_json
    from simtest.spec.camera import load_camera
    from simtest.spec.camera_formats.files import FORMATS, recognise
    from simtest.spec.camera_tables import camera_summary

    shown = camera_summary(load_camera(file, view_radius))
    shown = {"file": str(file), "format": FORMATS[recognise(file)].title, **shown}
    if as_json:
        print_json(shown)
    else:
        _print(shown)


def _print(shown: "dict[str, Any]") -> None:
    """Print a camera's summary as lines and a table."""
    from simtest.cli.printing import print_table

    (fx, skew, cx), (_, fy, cy), _ = shown["K"]
    print(f"{shown['file']}: {shown['format']}, {shown['width']} x {shown['height']} px")
    print(f"fx {fx:.8g}, fy {fy:.8g}, cx {cx:.8g}, cy {cy:.8g}{f', skew {skew:.6g}' if skew else ''} px")
    print("the centre of the first pixel is (0.5, 0.5)")
    told = {name: value for name, value in shown.get("distortion", {}).items() if name != "type"}
    print(f"lens: {shown['lens']}{''.join(f', {name} {value:.6g}' for name, value in told.items())}")
    if (mask := shown.get("view_mask")) is not None:
        print(f"view mask: {', '.join(f'{name} {value:.6g}' for name, value in mask.items())} px")
    spans = ", ".join(f"{name} {_cell(value, 2)}" for name, value in shown["fov_deg"].items())
    print(f"field of view, deg: {spans}")
    rows = [
        [
            each["at"],
            "{:.0f}, {:.0f}".format(*each["pixel"]),
            _cell(each["angle_deg"], 2) if each["in_view"] else "outside the view",
            _cell(each["moved_px"], 1) if each["in_view"] else "",
        ]
        for each in shown["border"]
    ]
    print_table(["border", "pixel", "deg off the axis", "px from a pinhole's"], rows)


def _cell(value: "float | None", digits: int) -> str:
    return "none" if value is None else f"{value:.{digits}f}"


@camera.command
def convert(
    file: Path,
    /,
    *,
    out: Annotated[Path, Parameter(help="File to write; replaced if it exists.", converter=named_path)],
    to: Annotated[
        Literal["toml", "opencv", "ros", "colmap", "transforms", "matlab"] | None,
        Parameter(help="Format; default by the suffix of --out."),
    ] = None,
    poses: Annotated[
        Path | None,
        Parameter(help="File whose poses are written too, for colmap and transforms: images.txt or transforms.json."),
    ] = None,
    photometric: Annotated[
        Path | None,
        Parameter(help="EndoMapper's photometric calibration, for toml: response, vignetting, light."),
    ] = None,
    view_radius: ViewRadius = None,
    as_json: AsJson = False,
) -> None:
    """Convert a camera file; the half pixel and the axes of both formats are seen to.

    Parameters
    ----------
    file : Path
        A camera file of any known format. FILE#ID names one camera of several.
    """
    from simtest.cli.printing import print_files
    from simtest.errors import InputError
    from simtest.runtime.locks import exclusive_file
    from simtest.spec.calibration_file import load_calibration, save_calibration
    from simtest.spec.camera import load_camera, save_camera

    if photometric is not None and (to or out.suffix.lower().removeprefix(".")) != "toml":
        raise InputError(f"--photometric {photometric}: needs --to toml; no other format holds it")
    if photometric is not None and poses is not None:
        raise InputError("--photometric and --poses exclude each other; no format holds both")
    with exclusive_file(out):
        if photometric is not None:
            save_calibration(load_calibration(file, photometric, view_radius), out)
        else:
            save_camera(load_camera(file, view_radius), out, to, None if poses is None else _frames(poses))
    print_files([out], as_json)


def _frames(poses: Path) -> "list[tuple[str, Array]]":
    """Read the poses of named frames, mm."""
    from simtest.errors import InputError
    from simtest.reconstruction.poses import read_poses

    found = read_poses(poses)
    if not found.names:
        raise InputError(f"--poses {poses}: names no frames; must do so, as images.txt does")
    return list(zip(found.names, found.world_from_camera, strict=True))
