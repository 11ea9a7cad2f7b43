"""`simtest reconstruct`."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from simtest.cli.options import Estimators, Out


def reconstruct(
    image: Path,
    /,
    *,
    out: Out,
    camera: Annotated[
        Path | None,
        Parameter(help="Calibration: the camera and what else is known of it; TOML, or a file of OpenCV, ROS, MATLAB."),
    ] = None,
    fov: Annotated[
        float | None, Parameter(help="Horizontal field of view in deg, where there is no calibration.")
    ] = None,
    estimators: Estimators = None,
    roi: Annotated[str | None, Parameter(help="Region of interest x,y,w,h in px; default: detected.")] = None,
    encoding: Annotated[
        Literal["srgb", "linear"] | None,
        Parameter(help="How the picture's values are encoded, where the calibration does not say; default srgb."),
    ] = None,
    every: Annotated[
        bool,
        Parameter(
            name="--all",
            negative="",
            help="Take peaks too that the border cuts or whose shape is not that of one point highlight.",
        ),
    ] = False,
) -> None:
    """Reconstruct the normals at the specularities of a picture: normals.json, normals.csv, normals.ply, overlay.png.

    Parameters
    ----------
    image : Path
        PNG, JPEG, BMP or TIFF.
    """
    from simtest.picture import reconstruct_picture

    count, files = reconstruct_picture(image, out, camera, fov, estimators, roi, encoding, every)
    print(f"{count} specularit{'y' if count == 1 else 'ies'} found in {image}")
    for file in files:
        print(file)
