"""Commands about pictures and cameras: reconstruct, twin, calibrate, camera."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from simtest.api import Extras, reconstruct_picture
from simtest.cli.common import (
    DEFAULTS,
    MOST_ROWS,
    NO_REGIONS,
    ONE_PROCESS,
    OUT,
    Distances,
    EngineOptions,
    NamedPath,
    Out,
    PictureOptions,
    RegionOptions,
    Seed,
    Table,
    Told,
    about,
    command,
    command_line,
    counted,
    few,
    fixed,
    flag,
    path,
    whole,
)
from simtest.cli.main import MANNERS
from simtest.cli.progress import progress_bar
from simtest.errors import InputError
from simtest.runtime.files import check_count
from simtest.runtime.locks import exclusive_file, exclusive_folder

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Any

    from simtest.advice.twin.run import SpotTwins, TwinResult
    from simtest.reconstruction.assumptions import Assumption
    from simtest.reconstruction.light_calibration.run import Ball, Calibrated, Plate
    from simtest.reconstruction.options import Options
    from simtest.reconstruction.records import Specularities, Specularity
    from simtest.runtime.arrays import Array

MOST_FLAGS = 3
"""Flags named in a row of the summary, the most frequent first."""

MEANING = (
    "± is the root mean square error that is expected of a normal: 95 % of errors lie within 1.7 to 2 times it "
    "(docs/concepts/uncertainty.md)"
)


NO_EXTRAS = Extras()


@command
def reconstruct(
    image: NamedPath,
    /,
    *,
    out: Annotated[Path | None, path("Folder for the results; default reports/normals/IMAGE.", OUT)] = None,
    known: PictureOptions = DEFAULTS,
    calibrated: RegionOptions = NO_REGIONS,
    roi: Annotated[str | None, about("Region of interest x,y,w,h in px; default: detected.")] = None,
    extras: Annotated[Extras, Parameter(name="*")] = NO_EXTRAS,
    poses: Annotated[
        Path | None,
        about("Poses of a sequence's frames: views.json, JSON of matrices or a TUM file; tells convex from concave."),
    ] = None,
) -> Told:
    """Reconstruct the normals at the specularities of a picture, of each picture of a folder, or of a video's frames.

    Exit 1 if a picture or frame was skipped.

    Parameters
    ----------
    image : Path
        PNG, JPEG, BMP or TIFF; a folder of these; or a video that OpenCV reads.
    """
    from simtest.reconstruction.images import is_sequence
    from simtest.reconstruction.options import parse_roi

    out = out or Path("reports/normals") / image.stem
    sequence = is_sequence(image)
    if sequence and any(vars(replace(extras, depth_scale=None)).values()):
        raise InputError(f"{image}: --reference, --camera-from-model and --depth are for single pictures")
    if poses and not sequence:
        raise InputError(f"{image}: --poses is for a folder or a film")
    options = known.checked(roi=None if roi is None else parse_roi(roi), poses=poses, regions=calibrated.read())
    if sequence:
        return _sequence(image, out, options)
    spots, files = reconstruct_picture(image, out, options, extras)
    return Told(files, spots.to_json, _record_parts(spots, image))


def _sequence(source: Path, out: Path, options: "Options") -> Told:
    """Reconstruct the frames of a folder or a video."""
    from dataclasses import asdict

    from simtest.reconstruction.sequence import reconstruct_sequence

    with progress_bar("writing the tables") as progress:
        made = reconstruct_sequence(source, out, options, progress)
    skipped = f", {made.failed} skipped" if made.failed else ""
    skipped += f" ({made.not_named} not named by --poses)" if made.not_named else ""
    found = counted(made.specularities, "specularity", "specularities")
    lines = [f"{counted(made.frames, 'frame')}{skipped}: {found}, {made.tracks} seen in several frames"]
    if len(made.sizes) > 1:
        sizes = ", ".join(f"{size} px ({counted(count, 'frame')})" for size, count in made.sizes.items())
        each = f"each size has a camera of {options.fov_deg:g} deg across its {options.fov_of}"
        lines.append(f"note: {sizes}: {each}; what is assumed in px is that of the last one")
    parts = (*assumed_lines(made.assumed), *lines, *([made.motion] if made.motion else []))
    return Told(made.files, asdict(made), parts, 1 if made.failed > made.not_named else 0)


def _record_parts(spots: "Specularities", image: Path) -> "Iterator[str | Table]":
    """Yield the best normals, what they state, what is assumed, and how many highlights have one."""
    # What tells the organ's normal leads; that nothing does is one of the remarks.
    if spots.clouds:
        yield spots.of_organ
    yield from record_tables(spots)
    if spots.stated is not None:
        yield f"reported: {spots.stated}"
        if (organ := spots.stated_of_organ) not in (None, spots.stated):
            yield f"of the organ below its relief: {organ}"
        yield MEANING
    if spots.calibrated:
        yield f"calibrated: {spots.calibrated}"
    yield from silent_lines(spots)
    if spots.of_organ and not spots.clouds:
        yield f"note: {spots.of_organ}"
    if note := spots.rule_note:
        yield f"note: {note}"
    yield from assumed_lines(spots.choices.assumed)
    yield from count_lines(spots, image)


def record_tables(spots: "Specularities") -> "Iterator[str | Table]":
    """Yield the best normals, or a summary of many, and how the estimators compare with a reference."""
    if len(spots) > MOST_ROWS and not MANNERS.verbose:
        yield _summary(spots)
        yield f"--verbose prints a row for each of the {len(spots)}; normals.csv and index.html hold them"
    elif spots:
        columns = ("no.", "x (px)", "y (px)", "kind", "score", "best", "normal", "± deg", "choice", "flags")
        yield Table(columns, [_cells(spot, spots.sightline_rule) for spot in spots])
    if (compared := spots.reference) is not None:
        yield from (f"reference: {problem}" for problem in compared.problems)
        rows = [
            (name, str(errors.n), _pair(errors.mean_deg, errors.std_deg),
             _pair(errors.mean_oracle_deg, errors.std_oracle_deg), _share(errors.inside), _share(errors.inside_organ),
             _share(errors.wrong_and_sure))
            for name, errors in compared.rows.items()
        ]  # fmt: skip
        of_errors = ("estimator", "n", "mean ± std (deg)", "better candidate (deg)")
        yield Table((*of_errors, "inside its 95 %", "the organ's 95 %", "wrong and sure"), rows)
        yield f"{compared.missed} sightlines miss {compared.source}"


def _summary(spots: "Specularities") -> Table:
    """Return how many specularities of each kind have which best estimator, and what that states."""
    from collections import Counter
    from statistics import median

    from simtest.reconstruction.explanations import kind_name
    from simtest.reconstruction.records import SIGHTLINE_RULE

    groups: dict[tuple[str, str], list[Specularity]] = {}
    rule = spots.sightline_rule
    for spot in spots:
        best = SIGHTLINE_RULE if spot.best in rule else spot.best or "none"
        kind = kind_name(spot.kind) if spot.cloud is None else "cloud"
        groups.setdefault((kind, best), []).append(spot)
    rows = []
    for (kind, best), held in sorted(groups.items(), key=lambda item: -len(item[1])):
        stated = [d for s in held if s.best_estimate and (d := s.best_estimate.deviation_deg) is not None]
        flags = Counter(flag for s in held if s.best_estimate for flag in s.best_estimate.flags)
        named = ", ".join(f"{flag} {count}" for flag, count in flags.most_common(MOST_FLAGS))
        rows.append((kind, best, str(len(held)), fixed(median(stated) if stated else None), named))
    return Table(("kind", "best", "n", "median ± deg", "flags"), rows)


def silent_lines(spots: "Sequence[Specularity]") -> "Iterator[str]":
    """Yield why best normals have no ±, and how many."""
    from collections import Counter

    from simtest.reconstruction.explanations import why_no_error

    reasons = Counter(why_no_error(s.best, s.best_estimate) for s in spots if s.best and s.best_estimate)
    for reason, count in reasons.items():
        if reason:
            yield f"no ± at {counted(count, 'best normal')}: {reason}"


def assumed_lines(assumed: "Sequence[Assumption]") -> "Iterator[str]":
    """Yield what the normals are without the light's position; what is given with a spread; what is assumed."""
    from simtest.reconstruction.assumptions import light_note

    if note := light_note(assumed):
        yield f"note: {note}"
    for each in sorted(assumed, key=lambda each: not each.given):
        yield f"given: {each.what}: {each.distribution}" if each.given else f"assumed: {each}"


def count_lines(spots: "Specularities", image: Path) -> "Iterator[str]":
    """Yield how many highlights were found, how many have a normal, and what the others are."""
    from simtest.reconstruction.assumptions import BORDERED
    from simtest.reconstruction.explanations import kinds_counted
    from simtest.reconstruction.pipeline import REFUSED

    for warning in spots.warnings:
        if warning.startswith((BORDERED, REFUSED)):
            yield f"note: {warning}"

    others = spots.detection.others
    answered = sum(spot.best is not None for spot in spots)
    found = f"{counted(len(spots), 'specularity', 'specularities')} found in {image}"
    yield found + (f", {answered} with a best normal" if answered < len(spots) else "")
    if spots.doubts:
        yield f"note: {spots.doubts}"
    if others:
        kinds = kinds_counted(each.kind for each in others)
        left = f"{counted(len(others), 'more highlight')} found and left out"
        yield f"{left}, because no single normal can be read from them: {kinds} (index.html shows them)"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _pair(mean: float, spread: float | None) -> str:
    return fixed(mean) if spread is None else f"{mean:.2f} ± {spread:.2f}"


def _cells(spot: "Specularity", rule: "Sequence[str]") -> list[str]:
    from simtest.reconstruction.explanations import kind_name
    from simtest.reconstruction.records import SIGHTLINE_RULE

    best, published = spot.best_estimate, spot.normals.get("circle_pose")
    x, y = (math.nan, math.nan) if spot.peak_px is None else spot.peak_px
    return [
        str(spot.id), fixed(x, 1), fixed(y, 1), kind_name(spot.kind), fixed(spot.score),
        SIGHTLINE_RULE if spot.best in rule else spot.best or "none",
        " ".join(f"{v:+.3f}" for v in best.normal) if best else "", fixed(best.deviation_deg if best else None),
        fixed(published.choice_margin if published else None, 1), ", ".join(best.flags) if best else "",
    ]  # fmt: skip


MOST_FRAMES = 1000


@command
def twin(
    frame: NamedPath,
    /,
    *,
    out: Out,
    known: PictureOptions = DEFAULTS,
    organ: Annotated[
        Literal["colon", "stomach", "liver", "gallbladder"] | None,
        about("Organ in the picture, whose relief the twins have; default: any tissue's."),
    ] = None,
    frames: Annotated[int | None, whole("Rendered frames; default 48, fewer where the picture is large.")] = None,
    seed: Seed = None,
) -> Told:
    """Render twins of a picture's highlights, and measure the error at each.

    Parameters
    ----------
    frame : Path
        PNG, JPEG, BMP or TIFF.
    """
    from simtest.advice.twin.run import to_json, twin_picture, write_twins

    if frames is not None:
        check_count(frames, "--frames", MOST_FRAMES)
    options, line = known.checked(), command_line()
    with exclusive_folder(out):
        with progress_bar("writing the page") as progress:
            result = twin_picture(frame, options, frames, seed or 0, progress, organ)
        files = write_twins(result, out, line)
    return Told(files, lambda: to_json(result, line), _twin_parts(result))


def _twin_parts(result: "TwinResult") -> "Iterator[str | Table]":
    """Yield the highlights, the bank and what was drawn."""
    columns = ("no.", "x (px)", "y (px)", "radius (px)", "best", "± deg", "twins deg", "95 % interval", "held")
    spots = sorted(result.spots, key=lambda each: -each.spot.radius_px)
    yield Table(columns, [_twin_cells(each) for each in spots[:MOST_ROWS]])
    if len(spots) > MOST_ROWS:
        yield f"the {MOST_ROWS} largest of {len(spots)}; twin.csv and index.html hold all"
    held = "" if result.coverage is None else f"; their 95 % regions hold the truth in {100 * result.coverage:.0f} %"
    if result.wrong_and_sure is not None:
        held += f", {100 * result.wrong_and_sure:.0f} % are wrong and sure"
    yield f"twins: {result.rms_deg():.2f} deg RMS against the fine normal{held}"
    yield f"twins: {result.rms_deg('base_rms_deg'):.2f} deg RMS against the base's normal"
    drawn = f"{counted(len(result.bank), 'rendered frame')}, {counted(len(result.bank_spots), 'highlight')} in them"
    yield f"bank: {drawn}, {100 * result.share_of('near_miss'):.0f} % near misses"
    near, middle, far = result.distance_mm
    yield f"twins stand at {near:.0f} to {far:.0f} mm (80 %), half nearer than {middle:.0f} mm"
    unlike = sum(not each.twins.is_covered for each in result.spots)
    if unlike:
        yield f"note: the bank holds no highlight like {unlike} of {len(spots)}; their figures are of the nearest ones"
    for each in result.assumed:
        yield f"given: {each.what}: {each.distribution}" if each.given else f"drawn: {each.what}: {each.distribution}"


def _twin_cells(each: "SpotTwins") -> list[str]:
    spot, twins = each.spot, each.twins
    x, y = spot.peak_px
    low, high = twins.interval_deg
    return [
        str(spot.index), fixed(x, 1), fixed(y, 1), fixed(spot.radius_px, 1), spot.estimator,
        fixed(each.stated_deg), fixed(twins.rms_deg),
        f"{low:.2f} to {high:.2f}", "" if twins.coverage is None else f"{100 * twins.coverage:.0f} %",
    ]  # fmt: skip


calibrate = App(name="calibrate", help="Measure where the lights are, or how far off a core's normals are.")


@calibrate.command(name="core")
@command
def core_(
    core: Annotated[str, about("An estimator by name, 'command: PROGRAM ARGUMENT...' or FILE.toml, as --estimator.")],
    /,
    *,
    scope: Annotated[str, about("A preset or a TOML file, as advise takes it.")],
    out: Annotated[Path, path("File of the calibration, JSON; answers to the frames stay in a folder beside it.", OUT)],
    organ: Annotated[str, about("colon, stomach, liver, gallbladder, or plane (a phantom).")] = "colon",
    distances: Distances = (20.0, 60.0),
    highlights: Annotated[int, whole("Answers that the calibration stands on, at least.")] = 2400,
    detector: Annotated[Literal["colour", "peaks"], about("As reconstruct or as validate finds them.")] = "colour",
    every: Annotated[bool, flag("Take highlights that are not isolated too.", "--all")] = False,
    seed: Seed = None,
    engine: EngineOptions = ONE_PROCESS,
) -> Told:
    """Find how far off a core's normals are, on rendered frames of your scope: a file for --regions of other commands.

    A stopped calibration goes on.
    """
    from simtest.advice.core_calibration import calibrate_core
    from simtest.advice.plan import Question
    from simtest.advice.scope import read_scope

    question = Question(read_scope(scope), organ, distances, seed=seed or 0)
    with exclusive_file(out), progress_bar() as progress:
        made = calibrate_core(core, question, out, highlights, detector, every, engine.make(), progress)
    lines = [f"{made.highlights} answers in {made.frames} frames"]
    for target, strata in made.strata.items():
        last = [part.error_deg[1] for part in strata.parts]
        lines.append(f"{target} normals: 95 % within {min(last):.3g} to {max(last):.3g} deg, in {len(last)} strata")
    return Told([out], made.model_dump(mode="json"), lines)


@calibrate.command
@command
def check(calibration: Path, pictures: list[Path], /) -> Told:
    """Compare pictures with the frames of a core's calibration, each and all together.

    Exit 1 if together they are unlike: its regions do not hold for them.

    Parameters
    ----------
    calibration : Path
        File of calibrate core.
    pictures : list of Path
        Pictures, or folders of pictures: 16 or more separate views.
    """
    from simtest.reconstruction.light_calibration.run import picture_readers
    from simtest.reconstruction.regions import check_frames, read_calibrations

    (own,) = read_calibrations([str(calibration)]).values()
    made = check_frames(own, picture_readers(pictures))
    how = f"{made['distance']:.3g} standard deviations off, of which {made['limit']:.3g} may be chance"
    alone = few([f"unlike by itself: {name}" for name in made["unlike_alone"]])
    head = f"{made['frames']} frames together are {'un' * made['unlike']}like those of {own.scope}: {how}"
    return Told([], made, [head, *alone], 1 if made["unlike"] else 0)


@calibrate.command
@command
def light(
    pictures: list[Path],
    /,
    *,
    camera: Annotated[Path, path("Calibration or camera file; the lights are added to what it states.")],
    out: Out,
    ball_radius: Annotated[float | None, about("Radius of the ball in the pictures, mm.")] = None,
    ball_radius_sd: Annotated[float, about("Standard deviation of that radius, mm.")] = 0.0,
    outlines: Annotated[
        Path | None, about("Rough outlines of the ball where it is not found: lines of name,x,y,radius in px (CSV).")
    ] = None,
    plate: Annotated[
        Path | None,
        about("Instead of a ball: poses of the camera to a flat plate in the plane z = 0, as of reconstruct."),
    ] = None,
    plate_sd: Annotated[float, about("Standard deviation of the plate's distance, mm.")] = 0.2,
    plate_tilt_sd: Annotated[float, about("Standard deviation of the plate's tilt an axis, deg.")] = 0.2,
    encoding: Annotated[
        Literal["srgb", "linear"] | None,
        about("How the values are encoded, where the calibration does not say; default srgb."),
    ] = None,
    most: Annotated[int, whole("Lights at most, 1 to 4.")] = 4,
) -> Told:
    """Measure where the lights are, from their highlights on a ball of known radius or on a flat plate at known poses.

    Exit 1 if the result is doubtful; then no calibration is written.

    Parameters
    ----------
    pictures : list of Path
        Pictures, or folders of pictures: the ball at 6 to 12 places, near and far, across the view.
    """
    from simtest.reconstruction.light_calibration.page import result_json, write_calibration
    from simtest.reconstruction.light_calibration.run import calibrate_lights, picture_readers
    from simtest.spec.calibration_file import load_calibration

    mirror = _mirror(ball_radius, ball_radius_sd, outlines, plate, (plate_sd, plate_tilt_sd))
    with exclusive_folder(out):
        made = calibrate_lights(picture_readers(pictures), load_calibration(camera), mirror, encoding, most)
        files = write_calibration(made, out, command_line())
    return Told(files, lambda: result_json(made), _light_parts(made), 1 if made.result.problems else 0)


def _mirror(
    radius: float | None, radius_sd: float, outlines: Path | None, plate: Path | None, plate_sd: tuple[float, float]
) -> "Ball | Plate":
    from simtest.reconstruction.light_calibration.run import Ball, Plate, circles_of

    if (radius is None) == (plate is None):
        raise InputError("--ball-radius or --plate: exactly one of them must be given")
    if radius is not None:
        return Ball(radius, radius_sd, None if outlines is None else circles_of(outlines))
    if outlines is not None or radius_sd:
        raise InputError("--outlines and --ball-radius-sd need --ball-radius")
    assert plate is not None
    return Plate(plate, *plate_sd)


def _light_parts(made: "Calibrated") -> "Iterator[str | Table]":
    result = made.result
    rows = []
    for number, each in enumerate(result.lights, 1):
        cells = [
            f"{value:+.3f} ± {half:.3f}" for value, half in zip(each.position_mm, each.half_widths_mm, strict=True)
        ]
        rows.append((str(number), *cells, str(each.pictures), "no: left out" if each.is_foreign else "yes"))
    yield Table(("light", "x (mm)", "y (mm)", "z (mm)", "pictures", "on the tip"), rows)
    yield "± is half of a 95 % interval; camera frame: x right, y down, z forward"
    used = counted(len(made.views.views), "picture")
    yield f"{used}, residuals {result.rms_px:.3f} px RMS an axis, chi2 {result.chi2:.1f} for {result.freedom}"
    yield from few([f"left out: {name}: {why}" for name, why in made.views.left_out.items()])
    yield from few([f"note: {note}" for note in result.notes])
    yield from few([f"problem: {problem}; no calibration was written" for problem in result.problems])


camera = App(name="camera", help="Show what a camera file means, or convert it to another program's format.")

ViewRadius = Annotated[
    float | None, about("Radius in px of the round view about the picture's centre, where the file states none.")
]


@camera.command
@command
def show(file: Path, /, *, view_radius: ViewRadius = None) -> Told:
    """Show a camera file as it is understood: format, fields of view, and what the lens does at the border.

    Parameters
    ----------
    file : Path
        A camera file of any known format. FILE#ID names one camera of several.
    """
    from simtest.spec.camera import load_camera
    from simtest.spec.camera_formats.files import FORMATS, recognise
    from simtest.spec.camera_tables import camera_summary

    shown = camera_summary(load_camera(file, view_radius))
    shown = {"file": str(file), "format": FORMATS[recognise(file)].title, **shown}
    return Told(data=shown, parts=_camera_parts(shown))


def _camera_parts(shown: "dict[str, Any]") -> "Iterator[str | Table]":
    """Yield a camera's summary as lines and a table."""
    (fx, skew, cx), (_, fy, cy), _ = shown["K"]
    yield f"{shown['file']}: {shown['format']}, {shown['width']} x {shown['height']} px"
    yield f"fx {fx:.8g}, fy {fy:.8g}, cx {cx:.8g}, cy {cy:.8g}{f', skew {skew:.6g}' if skew else ''} px"
    yield "the centre of the first pixel is (0.5, 0.5)"
    told = {name: value for name, value in shown.get("distortion", {}).items() if name != "type"}
    yield f"lens: {shown['lens']}{''.join(f', {name} {value:.6g}' for name, value in told.items())}"
    if (mask := shown.get("view_mask")) is not None:
        yield f"view mask: {', '.join(f'{name} {value:.6g}' for name, value in mask.items())} px"
    spans = ", ".join(f"{name} {fixed(value, missing='none')}" for name, value in shown["fov_deg"].items())
    yield f"field of view, deg: {spans}"
    rows = [
        [
            each["at"],
            "{:.0f}, {:.0f}".format(*each["pixel"]),
            fixed(each["angle_deg"], 2, "none") if each["in_view"] else "outside the view",
            fixed(each["moved_px"], 1, "none") if each["in_view"] else "",
        ]
        for each in shown["border"]
    ]
    yield Table(["border", "pixel", "deg off the axis", "px from a pinhole's"], rows)


@camera.command
@command
def convert(
    file: Path,
    /,
    *,
    out: Annotated[Path, path("File to write; replaced if it exists.", OUT)],
    to: Annotated[
        Literal["toml", "opencv", "ros", "colmap", "transforms", "matlab"] | None,
        about("Format; default by the suffix of --out."),
    ] = None,
    poses: Annotated[
        Path | None,
        about("File whose poses are written too, for colmap and transforms: images.txt or transforms.json."),
    ] = None,
    photometric: Annotated[
        Path | None, about("EndoMapper's photometric calibration, for toml: response, vignetting, light.")
    ] = None,
    view_radius: ViewRadius = None,
) -> Told:
    """Convert a camera file; the half pixel and the axes of both formats are seen to.

    Parameters
    ----------
    file : Path
        A camera file of any known format. FILE#ID names one camera of several.
    """
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
    return Told([out])


def _frames(poses: Path) -> "list[tuple[str, Array]]":
    """Read the poses of named frames, mm."""
    from simtest.reconstruction.poses import read_poses

    found = read_poses(poses)
    if not found.names:
        raise InputError(f"--poses {poses}: names no frames; must do so, as images.txt does")
    return list(zip(found.names, found.world_from_camera, strict=True))
