"""Commands about scenes: render, views, view, export, list, schema, doctor, mesh."""

import json
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from simtest.cli.common import (
    OUT,
    AsJson,
    Out,
    SceneName,
    Settings,
    Told,
    Variant,
    about,
    command,
    flag,
    path,
    print_json,
    replacing,
    seed_number,
    values_of,
    whole,
)
from simtest.cli.main import MANNERS
from simtest.cli.progress import progress_bar
from simtest.errors import InputError
from simtest.runtime.locks import exclusive_file, exclusive_folder


@command
def render(
    scene: SceneName,
    /,
    *,
    out: Annotated[Path | None, path("Folder for the results; default reports/frames/SCENE.", OUT)] = None,
    settings: Settings = None,
    variant: Variant = None,
) -> Told:
    """Render a scene with its ground truth: frame.png, radiance.exr, truth.npz, frame.json, camera.toml.

    calibration.toml holds what reconstruction is told of frame.png: camera, response, falloff, noise, lights, distance
    and lobe, as far as the scene says that they are known; `simtest reconstruct --camera` reads it.
    """
    from simtest import api

    out = out or Path("reports/frames") / Path(scene).stem
    with exclusive_folder(out):
        with progress_bar("finding the truth", stopped="nothing is written") as move:
            frame = api.render(scene, values_of(settings), variant, move)
        files = frame.write(out)
    return Told(files, {"highlights": len(frame.highlights)}, [frame.advice] if frame.advice else [])


@command
def views(
    scene: SceneName,
    /,
    *,
    out: Out,
    count: Annotated[int, whole("Views wanted, 1 to 1000.", ("--count", "-n"))] = 50,
    along: Annotated[
        str | None,
        Parameter(
            help="First,last share of the camera path: a sequence of views in order, none left out.",
            allow_leading_hyphen=True,
        ),
    ] = None,
    fps: Annotated[float | None, about("Frames a second of the sequence; default 25.")] = None,
    labels: Annotated[bool, flag("Write the sequence's optical flow and co-visibility.")] = False,
    settings: Settings = None,
    variant: Variant = None,
) -> Told:
    """Pick viewpoints of an anatomy that show isolated highlights: views.json, a picture of each, a sheet of all.

    With --along, a film along the camera path instead. The poses are written for other programs, too.
    """
    from simtest import api
    from simtest.spec import load_scene
    from simtest.validation.mesh_verdicts import verdicts_of

    ends = None if along is None else _ends(along)
    with progress_bar("sampling views") as move:
        sampled = api.sample_views(scene, out, count, values_of(settings), variant, move, ends, fps, labels)
    with_one = sum(view.isolated_highlights > 0 for view in sampled.views)
    counts = {"tried": sampled.tried, "kept": len(sampled.views), "with_isolated_highlight": with_one}
    lines = [
        f"{with_one} of {sampled.tried} views show an isolated highlight",
        *(f"left out: {number} ({reason})" for reason, number in sampled.rejected.items()),
        *([f"to find more: {sampled.remedy}"] if sampled.remedy else []),
        *(f"not written: {reason}" for reason in sampled.poses_left_out),
    ]
    if with_one <= sampled.tried / 2:
        # A coarse mesh shows highlights that are not the surface's.
        lines += map(str, verdicts_of([load_scene(scene, values_of(settings))]))
    return Told([out / "views.json"], counts | {"left_out": sampled.rejected}, lines)


def _ends(text: str) -> tuple[float, float]:
    try:
        first, last = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--along {text}: must be two shares of the path, such as 0.2,0.8") from None
    return first, last


@command
def view(
    scene: SceneName,
    /,
    *,
    screenshot: Annotated[Path | None, path("PNG to draw to, without a display, instead of opening a window.")] = None,
    page: Annotated[Path | None, path("HTML file with the scene to turn and zoom in a browser, offline.")] = None,
    settings: Settings = None,
    variant: Variant = None,
) -> Told:
    """Show a scene in 3D: surface coloured by curvature, camera, lights, true and estimated normals."""
    from simtest.report.viewer import (
        check_page,
        check_target,
        make_content,
        save_screenshot,
        show,
        write_scene_page,
    )
    from simtest.report.viewer.scene_page import PAGE_GRID
    from simtest.spec import load_scene

    described = load_scene(scene, values_of(settings))
    if page is not None:
        check_page(page)
    if screenshot is not None or page is None:
        check_target(screenshot)
    if screenshot is None and page is None:
        show(make_content(described, variant))
    if page is not None:
        with exclusive_file(page, "--page"):
            write_scene_page(make_content(described, variant, PAGE_GRID), page, described.name)
    if screenshot is not None:
        with exclusive_file(screenshot, "--screenshot"):
            save_screenshot(make_content(described, variant), screenshot)
    return Told([file for file in (page, screenshot) if file is not None])


@command
def export(scene: SceneName, /, *, out: Out, settings: Settings = None, variant: Variant = None) -> Told:
    """Write a scene as files that Mitsuba itself loads: scene.xml, and surface.ply where the surface is a mesh."""
    from simtest import api

    return Told(api.export(scene, out, values_of(settings), variant))


Kind = Literal["scenes", "experiments", "datasets", "profiles", "estimators", "detectors", "sensors", "rigs"]

HEADINGS = {
    "scenes": "for render, views, view, export",
    "experiments": "for validate",
    "datasets": "for dataset, fit --recipe",
    "profiles": "for nightly --profile",
    "estimators": "for --estimator",
    "detectors": "for reconstruct --detector",
    "sensors": "camera presets, for --set sensor.preset=NAME",
    "rigs": "presets of lights, for --set rig.preset=NAME",
}

LONGEST = 110
"""Characters about a name; --verbose and --json tell all."""


@command
def listing(kind: Kind | None = None, /) -> Told:
    """List what is shipped and installed, by the names that commands take, with a line about each.

    Parameters
    ----------
    kind : str
        What to list; default everything.
    """
    found = {each: names_of(each) for each in HEADINGS if kind in (None, each)}
    return Told(data=found, parts=_listed(found, kind is None))


def _listed(found: dict[str, dict[str, str]], has_headings: bool) -> Iterator[str]:
    for kind, names in found.items():
        if has_headings:
            yield f"{kind} ({HEADINGS[kind]})"
        width = max(map(len, names), default=0)
        for name, text in names.items():
            line = text if MANNERS.verbose else textwrap.shorten(text, LONGEST, placeholder=" ...")
            yield f"{'  ' * has_headings}{name:<{width}}  {line}".rstrip()


def names_of(kind: str) -> dict[str, str]:
    """Return the names of a kind, with a line about each."""
    from simtest.runtime.resources import EntryPointGroup
    from simtest.spec import shipped

    if kind in shipped.FOLDERS:
        return shipped.shipped_files(kind)
    if kind in ("estimators", "detectors"):
        from simtest.estimators.names import DESCRIPTIONS

        return EntryPointGroup(f"simtest.{kind}", kind[:-1]).described(DESCRIPTIONS if kind == "estimators" else None)
    return shipped.sensor_presets() if kind == "sensors" else shipped.rig_presets()


def schema(of: Literal["scene", "experiment", "dataset", "camera", "calibration", "profile"] = "scene", /) -> None:
    """Print the JSON schema of a file.

    Parameters
    ----------
    of : str
        What to describe.
    """
    from pydantic import BaseModel

    from simtest.spec import CalibrationSpec, CameraSpec, Dataset, Experiment, Profile, Scene

    models: dict[str, type[BaseModel]] = {
        "scene": Scene,
        "experiment": Experiment,
        "dataset": Dataset,
        "camera": CameraSpec,
        "calibration": CalibrationSpec,
        "profile": Profile,
    }
    print(json.dumps(models[of].model_json_schema(), indent=2))


def doctor(*, as_json: AsJson = False, variant: Variant = None) -> int:
    """Check the rendering backend in a child process and say how to mend it; exit 1 if it cannot render."""
    from simtest.rendering.backend import examine

    report = examine(variant)
    if as_json:
        print_json(report)
        return 0 if report.can_render else 1
    print(f"variant     {report.variant}")
    for candidate in report.candidates:
        print(f"libLLVM     {candidate.path}  ({candidate.origin}): {candidate.verdict}")
    if report.library:
        print(f"in use      {report.library}")
    for package, version in report.versions.items():
        print(f"{package:<11} {version}")
    print(f"rendering   {'works' if report.can_render else 'does not work'}")
    if report.problem:
        print(f"problem     {report.problem}")
    return 0 if report.can_render else 1


mesh = App(name="mesh", help="Check a mesh of yours, or make a colon or liver from its recipe.")

Seed = Annotated[int | None, Parameter(help="Seed of the shape; default the recipe's.", converter=seed_number)]


@mesh.command
@command
def check(
    file: Path,
    /,
    *,
    distance: float = 30.0,
    exponent: float | None = None,
    roughness: float | None = None,
    kind: Literal["auto", "lumen", "organ"] = "auto",
) -> Told:
    """Check what is wrong with a mesh, what is mended when it is used, and whether it is fine enough for highlights.

    Exit 1 if it is too coarse or has a problem that cannot be mended, 2 if it is no mesh that can be used.

    Parameters
    ----------
    file : Path
        A PLY, OBJ, STL or VTK file; lengths in mm.
    distance : float
        Distance of camera and light from the surface, mm.
    exponent : float, optional
        Phong exponent of the highlights; default 200.
    roughness : float, optional
        GGX roughness alpha instead of an exponent.
    kind : str
        Which side the camera is on; auto goes by the shape.
    """
    from simtest.surfaces.mesh_check import check_mesh
    from simtest.surfaces.mesh_surface import concentration

    if not 0.1 <= distance <= 1e4:
        raise InputError(f"--distance {distance:g}: must be 0.1 to 10000 mm")
    verdict = check_mesh(file, distance, concentration(exponent, roughness), kind)
    return Told(data=verdict, parts=verdict.lines(), code=0 if verdict.usable else 1)


@Parameter(name="*")
@dataclass(frozen=True)
class Recipe:
    """The options of an anatomy: its recipe, and where its mesh goes."""

    out: Annotated[Path, path("File to write: .ply, .obj or .stl.", OUT)]
    seed: Seed = None
    edge_mm: Annotated[float | None, about("Edge length, mm; default that of the scenes.")] = None
    recipe: Annotated[Path | None, path("Recipe file (TOML); default the shipped one.")] = None
    settings: Annotated[list[str] | None, replacing("length_mm=40")] = None
    curvature: Annotated[bool, flag("Write the principal curvatures k_min and k_max, 1/mm, into a PLY file.")] = False


@mesh.command
@command
def colon(*, options: Recipe) -> Told:
    """Make a colon from its recipe: another one for each seed, the same bytes for the same."""
    return _make("colon", options)


@mesh.command
@command
def liver(*, options: Recipe) -> Told:
    """Make a liver from its recipe: another one for each seed, the same bytes for the same."""
    return _make("liver", options)


def _make(kind: Literal["colon", "liver"], given: Recipe) -> Told:
    from simtest.surfaces.factory import make_mesh
    from simtest.surfaces.mesh_file import check_target, write_mesh
    from simtest.surfaces.recipe import load_anatomy

    check_target(given.out)
    if given.curvature and given.out.suffix.lower() != ".ply":
        raise InputError(f"--curvature: {given.out.suffix} files hold none; allowed: .ply")
    anatomy = load_anatomy(kind, given.recipe, given.seed, values_of(given.settings))
    with exclusive_file(given.out):
        made, k_min, k_max = make_mesh(anatomy, given.edge_mm)
        write_mesh(given.out, made, {"k_min": k_min, "k_max": k_max} if given.curvature else None)
    told = {"file": str(given.out), "vertices": len(made.vertices), "faces": len(made.faces)}
    return Told(data=told, parts=["{file}: {vertices} vertices, {faces} faces".format_map(told)])
