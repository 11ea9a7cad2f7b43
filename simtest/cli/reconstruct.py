"""`simtest reconstruct`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from simtest.cli.manners import MANNERS
from simtest.cli.options import AsJson, Out, named_path
from simtest.cli.picture_options import DEFAULTS, PictureOptions
from simtest.cli.printing import MOST_ROWS, counted, print_files, print_json, print_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from simtest.reconstruction.assumptions import Assumption
    from simtest.reconstruction.description import PictureRecord, SpecularityRecord
    from simtest.reconstruction.picture import Options

MOST_FLAGS = 3
"""Flags named in a row of the summary, the most frequent first."""

MEANING = (
    "± is the root mean square error that is expected of a normal: 95 % of errors lie within 1.7 to 2 times it "
    "(docs/concepts/uncertainty.md)"
)

Roi = Annotated[str | None, Parameter(help="Region of interest x,y,w,h in px; default: detected.")]
Reference = Annotated[Path | None, Parameter(help="Mesh in mm, or depth map, that the normals are compared with.")]
ReferenceFormat = Annotated[
    str | None, Parameter(help="Data set whose map the reference is: c3vd, simcol3d, ucl or endoslam.")
]
Pose = Annotated[
    Path | None, Parameter(help="Pose of the reference mesh: TOML with matrix, or rotation and translation_mm.")
]
Depth = Annotated[
    str | None, Parameter(help="Depth at which the points of normals.ply stand: mm, or a depth map; default 1.")
]
Poses = Annotated[
    Path | None,
    Parameter(
        help="Poses of a sequence's frames: views.json, JSON of matrices or a TUM file; tells convex from concave."
    ),
]
DepthScale = Annotated[float | None, Parameter(help="mm of one step of an integer depth map.")]


def reconstruct(
    image: Annotated[Path, Parameter(converter=named_path)],
    /,
    *,
    out: Out,
    known: PictureOptions = DEFAULTS,
    roi: Roi = None,
    reference: Reference = None,
    reference_format: ReferenceFormat = None,
    camera_from_model: Pose = None,
    depth: Depth = None,
    depth_scale: DepthScale = None,
    poses: Poses = None,
    as_json: AsJson = False,
) -> None:
    """Reconstruct the normals at the specularities of a picture, of each picture of a folder, or of a video's frames.

    Parameters
    ----------
    image : Path
        PNG, JPEG, BMP or TIFF; a folder of these; or a video that OpenCV reads.
    """
    from simtest.errors import InputError
    from simtest.reconstruction.image_io import is_sequence
    from simtest.reconstruction.picture import parse_roi

    sequence = is_sequence(image)
    if sequence and (reference or reference_format or camera_from_model or depth):
        raise InputError(f"{image}: --reference, --camera-from-model and --depth are for single pictures")
    if poses and not sequence:
        raise InputError(f"{image}: --poses is for a folder or a film")
    box = None if roi is None else parse_roi(roi)
    options = known.checked(box, poses)
    if sequence:
        _sequence(image, out, options, as_json)
        return
    from simtest.api import Extras, reconstruct_picture

    extras = Extras(reference, camera_from_model, depth, depth_scale, reference_format)
    record, files = reconstruct_picture(image, out, options, extras)
    if as_json:
        print_files(files, as_json, **record.to_json())
        return
    _print_tables(record)
    if record.stated is not None:
        print(f"reported: {record.stated}")
        print(MEANING)
    _print_silent(record.specularities)
    _print_assumed(record.assumed)
    _print_counts(record, image)
    print_files(files, as_json)


def _sequence(source: Path, out: Path, options: "Options", as_json: bool) -> None:
    """Reconstruct the frames of a folder or a video, and print what came of them."""
    from dataclasses import asdict

    from simtest.cli.progress import progress_bar
    from simtest.reconstruction.sequence import reconstruct_sequence

    with progress_bar("writing the tables") as progress:
        made = reconstruct_sequence(source, out, options, progress)
    if as_json:
        print_json(asdict(made))
        return
    _print_assumed(made.assumed)
    unread = f", {made.failed} unreadable" if made.failed else ""
    found = counted(made.specularities, "specularity", "specularities")
    print(f"{counted(made.frames, 'frame')}{unread}: {found}, {made.tracks} seen in several frames")
    if made.motion:
        print(made.motion)
    print_files(made.files, as_json)


def _print_tables(record: "PictureRecord") -> None:
    """Print the best normals, or a summary of many, and how the estimators compare with a reference."""
    spots = record.specularities
    if len(spots) > MOST_ROWS and not MANNERS.verbose:
        _print_summary(spots)
    elif spots:
        columns = ("no.", "x (px)", "y (px)", "kind", "score", "best", "normal", "± deg", "choice", "flags")
        print_table(columns, [_cells(spot) for spot in spots])
    if (compared := record.reference) is not None:
        for problem in compared.problems:
            print(f"reference: {problem}")
        rows = [
            (name, str(errors.n), _pair(errors.mean_deg, errors.std_deg),
             _pair(errors.mean_oracle_deg, errors.std_oracle_deg))
            for name, errors in compared.estimators.items()
        ]  # fmt: skip
        print_table(("estimator", "n", "mean ± std (deg)", "better candidate (deg)"), rows)
        print(f"{compared.missed} sightlines miss {compared.source}")


def _print_summary(spots: "Sequence[SpecularityRecord]") -> None:
    """Print how many specularities of each kind have which best estimator, and what that states."""
    from collections import Counter
    from statistics import median

    from simtest.reconstruction.explanations import kind_name

    groups: dict[tuple[str, str], list[SpecularityRecord]] = {}
    for spot in spots:
        groups.setdefault((kind_name(spot.kind), spot.best or "none"), []).append(spot)
    rows = []
    for (kind, best), held in sorted(groups.items(), key=lambda item: -len(item[1])):
        stated = [d for s in held if s.best_estimate and (d := s.best_estimate.deviation_deg) is not None]
        flags = Counter(flag for s in held if s.best_estimate for flag in s.best_estimate.flags)
        named = ", ".join(f"{flag} {count}" for flag, count in flags.most_common(MOST_FLAGS))
        rows.append((kind, best, str(len(held)), f"{median(stated):.2f}" if stated else "", named))
    print_table(("kind", "best", "n", "median ± deg", "flags"), rows)
    print(f"--verbose prints a row for each of the {len(spots)}; normals.csv and index.html hold them")


def _print_silent(spots: "Sequence[SpecularityRecord]") -> None:
    """Print why best normals have no ±, and how many."""
    from collections import Counter

    from simtest.reconstruction.explanations import why_no_error

    reasons = Counter(why_no_error(s.best, s.best_estimate) for s in spots if s.best and s.best_estimate)
    for reason, count in reasons.items():
        if reason:
            print(f"no ± at {counted(count, 'best normal')}: {reason}")


def _print_assumed(assumed: "Sequence[Assumption]") -> None:
    """Print what the normals are without the light's position; what is given with a spread; what is assumed."""
    from simtest.reconstruction.assumptions import light_note

    if note := light_note(assumed):
        print(f"note: {note}")
    for each in sorted(assumed, key=lambda each: not each.given):
        print(f"given: {each.what}: {each.distribution}" if each.given else f"assumed: {each}")


def _print_counts(record: "PictureRecord", image: Path) -> None:
    """Print how many highlights were found, how many have a normal, and what the others are."""
    from simtest.reconstruction.borders import BORDERED
    from simtest.reconstruction.explanations import kinds_counted
    from simtest.reconstruction.picture import REFUSED

    for warning in record.warnings:
        if warning.startswith((BORDERED, REFUSED)):
            print(f"note: {warning}")

    spots, others = record.specularities, record.other_highlights
    answered = sum(spot.best is not None for spot in spots)
    found = f"{counted(len(spots), 'specularity', 'specularities')} found in {image}"
    print(found + (f", {answered} with a normal" if answered < len(spots) else ""))
    if others:
        kinds = kinds_counted(each.kind for each in others)
        left = f"{counted(len(others), 'more highlight')} found and left out"
        print(f"{left}, because no single normal can be read from them: {kinds} (index.html shows them)")


def _pair(mean: float, spread: float | None) -> str:
    return f"{mean:.2f}" + ("" if spread is None else f" ± {spread:.2f}")


def _cells(spot: "SpecularityRecord") -> list[str]:
    from simtest.reconstruction.explanations import kind_name

    best, published = spot.best_estimate, spot.normals.get("circle_pose")
    x, y = (math.nan, math.nan) if spot.peak_px is None else spot.peak_px
    deviation = None if best is None else best.deviation_deg
    margin = None if published is None else published.choice_margin
    return [
        str(spot.id), f"{x:.1f}", f"{y:.1f}", kind_name(spot.kind), "" if spot.score is None else f"{spot.score:.2f}",
        spot.best or "none",
        " ".join(f"{v:+.3f}" for v in best.normal) if best else "", "" if deviation is None else f"{deviation:.2f}",
        "" if margin is None else f"{margin:.1f}", ", ".join(best.flags) if best else "",
    ]  # fmt: skip
