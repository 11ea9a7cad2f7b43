"""`simtest reconstruct`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from simtest.cli.options import Estimators, Out, named_path

if TYPE_CHECKING:
    from collections.abc import Sequence

    from simtest.reconstruction.assumptions import Assumption
    from simtest.reconstruction.description import PictureRecord, SpecularityRecord

TABLE_WIDTH = 125


def reconstruct(
    image: Annotated[Path, Parameter(converter=named_path)],
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
        str,
        Parameter(
            help="colour: by the tissue's colour; peaks; or the name of another package's. "
            "auto: by colour where there is any."
        ),
    ] = "auto",
    smoothing: Annotated[
        float | None, Parameter(help="Smoothing in px; default 1 where found by colour, else 2.")
    ] = None,
    target: Annotated[
        Literal["fine", "base"],
        Parameter(help="Whose normals: the fine surface's, or the base's, with the relief's slope in the uncertainty."),
    ] = "fine",
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
    from simtest.errors import InputError
    from simtest.reconstruction.image_io import is_sequence
    from simtest.reconstruction.picture import Options, parse_roi

    sequence = is_sequence(image)
    if sequence and (reference or camera_from_model or depth):
        raise InputError(f"{image}: --reference, --camera-from-model and --depth are for single pictures")
    box = None if roi is None else parse_roi(roi)
    names = None if estimators is None else tuple(estimators)
    options = Options(camera, fov, names, box, encoding, every, detector, smoothing, target)
    if not sequence:
        from simtest.api import Extras, reconstruct_picture

        extras = Extras(reference, camera_from_model, depth, depth_scale)
        record, files = reconstruct_picture(image, out, options, extras)
        _print_tables(record)
        if record.stated is not None:
            print(f"stated: {record.stated}")
        _print_assumed(record.assumed)
        count = len(record.specularities)
        print(f"{count} specularit{'y' if count == 1 else 'ies'} found in {image}")
    else:
        from simtest.cli.progress import progress_bar
        from simtest.reconstruction.sequence import reconstruct_sequence

        with progress_bar("writing the tables") as progress:
            made = reconstruct_sequence(image, out, options, progress)
        files = made.files
        _print_assumed(made.assumed)
        unread = f", {made.failed} unreadable" if made.failed else ""
        print(f"{made.frames} frames{unread}: {made.specularities} specularities, {made.tracks} seen in several frames")
    for file in files:
        print(file)


def _print_tables(record: "PictureRecord") -> None:
    """Print the best normal of each specularity, and how the estimators compare with a reference."""
    from rich.console import Console
    from rich.table import Table

    # Without the names of emojis, which take as long to load as the table to print.
    console = Console(emoji=False)
    # Narrower, normals would be cut off.
    console.width = max(console.width, TABLE_WIDTH)
    if record.specularities:
        table = Table("no.", "x (px)", "y (px)", "kind", "score", "best", "normal", "± deg", "choice", "flags")
        for spot in record.specularities:
            table.add_row(*_cells(spot))
        console.print(table)
    if (compared := record.reference) is not None:
        for problem in compared.problems:
            print(f"reference: {problem}")
        table = Table("estimator", "n", "mean ± std (deg)", "better candidate (deg)")
        for name, errors in compared.estimators.items():
            proposed = _pair(errors.mean_deg, errors.std_deg)
            table.add_row(name, str(errors.n), proposed, _pair(errors.mean_oracle_deg, errors.std_oracle_deg))
        console.print(table)
        print(f"{compared.missed} sightlines miss {compared.source}")


def _print_assumed(assumed: "Sequence[Assumption]") -> None:
    """Print what nobody told, how it is taken, and how to narrow it."""
    for each in assumed:
        print(f"assumed: {each}")


def _pair(mean: float, spread: float | None) -> str:
    return f"{mean:.2f}" + ("" if spread is None else f" ± {spread:.2f}")


def _cells(spot: "SpecularityRecord") -> list[str]:
    from simtest.reconstruction.ranking import deviation_deg

    best, published = spot.best_estimate, spot.normals.get("circle_pose")
    x, y = (math.nan, math.nan) if spot.peak_px is None else spot.peak_px
    deviation = None if best is None else deviation_deg(best)
    margin = None if published is None else published.choice_margin
    return [
        str(spot.id), f"{x:.1f}", f"{y:.1f}", spot.kind or "", "" if spot.score is None else f"{spot.score:.2f}",
        spot.best or "none",
        " ".join(f"{v:+.3f}" for v in best.normal) if best else "", "" if deviation is None else f"{deviation:.2f}",
        "" if margin is None else f"{margin:.1f}", ", ".join(best.flags) if best else "",
    ]  # fmt: skip
