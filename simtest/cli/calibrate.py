"""`simtest calibrate`: measure what a calibration file states."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from simtest.cli.options import AsJson, Out, named_path, whole_number

if TYPE_CHECKING:
    from simtest.reconstruction.light_calibration.run import Ball, Calibrated, Plate

calibrate = App(name="calibrate", help="Measure what a calibration file states: the positions of the lights.")


@calibrate.command
def light(
    pictures: list[Path],
    /,
    *,
    camera: Annotated[
        Path,
        Parameter(help="Calibration or camera file; the lights are added to what it states.", converter=named_path),
    ],
    out: Out,
    ball_radius: Annotated[float | None, Parameter(help="Radius of the ball in the pictures, mm.")] = None,
    ball_radius_sd: Annotated[float, Parameter(help="Standard deviation of that radius, mm.")] = 0.0,
    outlines: Annotated[
        Path | None,
        Parameter(help="Rough outlines of the ball where it is not found: lines of name,x,y,radius in px (CSV)."),
    ] = None,
    plate: Annotated[
        Path | None,
        Parameter(help="Instead of a ball: poses of the camera to a flat plate in the plane z = 0, as of reconstruct."),
    ] = None,
    plate_sd: Annotated[float, Parameter(help="Standard deviation of the plate's distance, mm.")] = 0.2,
    plate_tilt_sd: Annotated[float, Parameter(help="Standard deviation of the plate's tilt an axis, deg.")] = 0.2,
    encoding: Annotated[
        Literal["srgb", "linear"] | None,
        Parameter(help="How the values are encoded, where the calibration does not say; default srgb."),
    ] = None,
    most: Annotated[int, Parameter(help="Lights at most, 1 to 4.", converter=whole_number)] = 4,
    as_json: AsJson = False,
) -> int:
    """Measure where the lights are, from their highlights on a ball of known radius or on a flat plate at known poses.

    Exit 1 if the result is doubtful; then no calibration is written.

    Parameters
    ----------
    pictures : list of Path
        Pictures, or folders of pictures: the ball at 6 to 12 places, near and far, across the view.
    """
    from simtest.cli.printing import print_files
    from simtest.reconstruction.light_calibration.run import calibrate_lights, picture_readers
    from simtest.reconstruction.light_calibration.write import result_json, write_calibration
    from simtest.runtime.locks import exclusive_folder
    from simtest.spec.calibration_file import load_calibration

    mirror = _mirror(ball_radius, ball_radius_sd, outlines, plate, (plate_sd, plate_tilt_sd))
    command = shlex.join(["simtest", *sys.argv[1:]])
    with exclusive_folder(out):
        made = calibrate_lights(picture_readers(pictures), load_calibration(camera), mirror, encoding, most)
        files = write_calibration(made, out, command)
    if as_json:
        print_files(files, as_json, **result_json(made))
    else:
        _print_result(made)
        print_files(files, as_json)
    return 1 if made.result.problems else 0


def _mirror(
    radius: float | None, radius_sd: float, outlines: Path | None, plate: Path | None, plate_sd: tuple[float, float]
) -> "Ball | Plate":
    from simtest.errors import InputError
    from simtest.reconstruction.light_calibration.observations import circles_of
    from simtest.reconstruction.light_calibration.run import Ball, Plate

    if (radius is None) == (plate is None):
        raise InputError("--ball-radius or --plate: exactly one of them must be given")
    if radius is not None:
        return Ball(radius, radius_sd, None if outlines is None else circles_of(outlines))
    if outlines is not None or radius_sd:
        raise InputError("--outlines and --ball-radius-sd need --ball-radius")
    assert plate is not None
    return Plate(plate, *plate_sd)


def _print_result(made: "Calibrated") -> None:
    from simtest.cli.printing import counted, print_lines, print_table

    result = made.result
    rows = []
    for number, each in enumerate(result.lights, 1):
        cells = [
            f"{value:+.3f} ± {half:.3f}" for value, half in zip(each.position_mm, each.half_widths_mm, strict=True)
        ]
        rows.append((str(number), *cells, str(each.pictures), "no: left out" if each.is_foreign else "yes"))
    print_table(("light", "x (mm)", "y (mm)", "z (mm)", "pictures", "on the tip"), rows)
    print("± is half of a 95 % interval; camera frame: x right, y down, z forward")
    used = counted(len(made.views.views), "picture")
    print(f"{used}, residuals {result.rms_px:.3f} px RMS an axis, chi2 {result.chi2:.1f} for {result.freedom}")
    print_lines([f"left out: {name}: {why}" for name, why in made.views.left_out.items()])
    print_lines([f"note: {note}" for note in result.notes])
    print_lines([f"problem: {problem}; no calibration was written" for problem in result.problems])
