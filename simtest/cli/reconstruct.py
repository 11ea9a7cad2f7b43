"""`simtest reconstruct`."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from simtest.cli.options import Estimators, Out

TABLE_WIDTH = 125


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
    detector: Annotated[
        Literal["auto", "colour", "peaks"],
        Parameter(help="Find highlights by the tissue's colour, or as peaks; auto: by colour where there is any."),
    ] = "auto",
    smoothing: Annotated[
        float | None, Parameter(help="Smoothing in px; default 1 where found by colour, else 2.")
    ] = None,
    every: Annotated[
        bool,
        Parameter(
            name="--all",
            negative="",
            help="Take peaks too that the border cuts or whose shape is not that of one point highlight.",
        ),
    ] = False,
    reference: Annotated[
        Path | None, Parameter(help="Mesh in mm, or depth map, that the normals are compared with.")
    ] = None,
    camera_from_model: Annotated[
        Path | None, Parameter(help="Pose of the reference mesh: TOML with matrix, or rotation and translation_mm.")
    ] = None,
    depth: Annotated[
        str | None, Parameter(help="Depth at which normals.ply and arrows.ply stand: mm, or a depth map; default 1.")
    ] = None,
    depth_scale: Annotated[float | None, Parameter(help="mm of one step of an integer depth map.")] = None,
) -> None:
    """Reconstruct the normals at the specularities of a picture, of each picture of a folder, or of a video's frames.

    Parameters
    ----------
    image : Path
        PNG, JPEG, BMP or TIFF; a folder of these; or a video that OpenCV reads.
    """
    from simtest.api import Extras, reconstruct_picture
    from simtest.errors import InputError
    from simtest.reconstruction.image_sources import is_sequence
    from simtest.reconstruction.picture import parse_roi

    if not is_sequence(image):
        extras = Extras(reference, camera_from_model, depth, depth_scale)
        count, files = reconstruct_picture(
            image, out, camera, fov, estimators, roi, encoding, every, detector, smoothing, extras
        )
        _print_table(files[0])
        print(f"{count} specularit{'y' if count == 1 else 'ies'} found in {image}")
        for file in files:
            print(file)
        return
    if reference or camera_from_model or depth:
        raise InputError(f"{image}: --reference, --camera-from-model and --depth are for single pictures")
    from simtest.cli.progress import progress_bar
    from simtest.reconstruction.sequence import reconstruct_sequence
    from simtest.reconstruction.single import Options

    box = None if roi is None else parse_roi(roi)
    options = Options(None if estimators is None else tuple(estimators), box, encoding, every, detector, smoothing)
    with progress_bar("writing the tables") as progress:
        result = reconstruct_sequence(image, out, camera, fov, options, progress)
    unread = f", {result.failed} unreadable" if result.failed else ""
    print(
        f"{result.frames} frames{unread}: {result.specularities} specularities, {result.tracks} seen in several frames"
    )
    for file in result.files:
        print(file)


def _print_table(file: Path) -> None:
    """Print the best normal of each specularity, and how the estimators compare with a reference."""
    import json

    from rich.console import Console
    from rich.table import Table

    document = json.loads(file.read_text(encoding="utf-8"))
    console = Console()
    # Narrower, normals would be cut off.
    console.width = max(console.width, TABLE_WIDTH)
    if document["specularities"]:
        table = Table("no.", "x (px)", "y (px)", "kind", "score", "best", "normal", "± deg", "choice", "flags")
        for spot in document["specularities"]:
            table.add_row(*_cells(spot))
        console.print(table)
    if compared := document.get("reference"):
        for problem in compared["problems"]:
            print(f"reference: {problem}")
        table = Table("estimator", "n", "mean ± std (deg)", "better candidate (deg)")
        for name, row in compared["estimators"].items():
            table.add_row(name, str(row["n"]), _pair(row, "mean_deg", "std_deg"),
                          _pair(row, "mean_oracle_deg", "std_oracle_deg"))  # fmt: skip
        console.print(table)
        print(f"{compared['missed']} sightlines miss {compared['source']}")


def _pair(row: dict[str, float | None], mean: str, spread: str) -> str:
    return f"{row[mean]:.2f}" + ("" if row[spread] is None else f" ± {row[spread]:.2f}")


def _cells(spot: dict[str, Any]) -> list[str]:
    result = spot["estimates"].get(spot["best"]) or {}
    published = spot["estimates"].get("circle_pose") or {}
    x, y = spot["peak_px"] or (float("nan"), float("nan"))
    covariance, margin = result.get("covariance"), published.get("choice_margin")
    deviation = "" if covariance is None else f"{57.29578 * (covariance[0][0] + covariance[1][1]) ** 0.5:.2f}"
    score = spot.get("score")
    return [
        str(spot["id"]), f"{x:.1f}", f"{y:.1f}", spot.get("kind", ""), "" if score is None else f"{score:.2f}",
        spot["best"] or "none", " ".join(f"{v:+.3f}" for v in result.get("normal", ())), deviation,
        "" if margin is None else f"{margin:.1f}", ", ".join(result.get("flags", ())),
    ]  # fmt: skip
