"""The workflows behind the commands: render a labelled frame, run an experiment with its report."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simtest.errors import InputError
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime.engines import Engine, make_engine
from simtest.runtime.files import make_folder, write_json
from simtest.simulation.labelled_frame import LabelledFrame, make_frame
from simtest.simulation.viewpoints import SampledViews
from simtest.spec import Experiment, Scene, load_experiment, load_scene
from simtest.validation.runner import Progress

if TYPE_CHECKING:
    from simtest.geometry import Camera
    from simtest.validation.reference_surface import Reference

__all__ = [
    "Extras",
    "LabelledFrame",
    "export",
    "reconstruct",
    "reconstruct_picture",
    "render",
    "sample_views",
    "validate",
]

MAX_VIEWS = 1000

TRIES = 10
"""Places that are tried for each view wanted."""


def render(
    scene: Scene | str | Path,
    settings: Mapping[str, Any] | None = None,
    variant: str | None = None,
    progress: Progress | None = None,
) -> LabelledFrame:
    """Render a scene with its ground truth.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a scene file, or the name of a shipped scene.
    settings : mapping, optional
        Values that replace those of a scene file, by key path, such as ``{"surface.radius_mm": 5.0}``.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        Called with samples done, samples in all, and what is done; what it raises stops the frame.

    Returns
    -------
    LabelledFrame

    Raises
    ------
    InputError
        If the scene is malformed or the camera sees no surface.
    BackendError
        If the rendering backend cannot be used.
    """
    described = scene if isinstance(scene, Scene) else load_scene(scene, settings)
    return make_frame(described, variant, progress)


def export(
    scene: Scene | str | Path,
    out: str | Path,
    settings: Mapping[str, Any] | None = None,
    variant: str | None = None,
) -> list[Path]:
    """Write a scene as files that Mitsuba itself loads: scene.xml, and surface.ply where the surface is a mesh.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a scene file, or the name of a shipped scene.
    out : str or Path
        Folder, made if need be.
    settings : mapping, optional
        Values that replace those of a scene file, by key path.
    variant : str, optional
        Mitsuba variant that parses the scene; the files are the same for all.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        If the scene is malformed, its camera or a light has what Mitsuba cannot express, or `out` cannot be written.
    BackendError
        If the rendering backend cannot be used.
    """
    from simtest.rendering.mitsuba_export import export_scene

    described = scene if isinstance(scene, Scene) else load_scene(scene, settings)
    return export_scene(described, Path(out), variant)


def sample_views(
    scene: Scene | str | Path,
    out: str | Path,
    count: int = 50,
    settings: Mapping[str, Any] | None = None,
    variant: str | None = None,
    progress: Progress | None = None,
    along: tuple[float, float] | None = None,
) -> SampledViews:
    """Pick viewpoints of an anatomy that show isolated highlights, or follow its camera path.

    Tried are the viewpoints 0, 1, 2, ..., or, where ``surface.view`` is not auto, places spread evenly over the camera
    path; ten for each view wanted at most. Written are views.json, with the poses and what was left out, a picture of
    each view, and sheet.png, which shows all of them; of a sequence film.avi too.

    Parameters
    ----------
    scene : Scene, str or Path
        Of an anatomy.
    out : str or Path
        Folder, made if need be.
    count : int
        Views wanted, 1 to 1000.
    settings : mapping, optional
        Values that replace those of a scene file, by key path.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        Called with views found, views wanted, and what was tried.
    along : tuple of float, optional
        First and last share of the camera path: a sequence of views evenly spaced between them, none left out.

    Returns
    -------
    SampledViews

    Raises
    ------
    InputError
        If the scene is malformed or no anatomy's, or `count` is out of range.
    BackendError
        If the rendering backend cannot be used.
    """
    from simtest.simulation.view_files import ViewWriter
    from simtest.simulation.viewpoints import along_path, candidates, sample_views, viewpoint_key

    if not 1 <= count <= MAX_VIEWS:
        raise InputError(f"count = {count}: must be 1 to {MAX_VIEWS}")
    described = scene if isinstance(scene, Scene) else load_scene(scene, settings)
    viewpoints = candidates(described, TRIES * count) if along is None else along_path(described, count, *along)
    make_folder(Path(out))
    writer = ViewWriter(Path(out), film=along is not None)
    sampled = sample_views(described, count, viewpoints, variant, progress, writer.add, along is not None)
    writer.close()
    write_json(Path(out) / "views.json", sampled.to_json(viewpoint_key(described)))
    return sampled


def validate(
    experiment: Experiment | str | Path,
    out: str | Path,
    settings: Mapping[str, Any] | None = None,
    command: str = "",
    variant: str | None = None,
    progress: Progress | None = None,
    workers: int = 1,
    engine: Engine | None = None,
) -> Path:
    """Run an experiment and write its report.

    Parameters
    ----------
    experiment : Experiment, str or Path
        An experiment, its file, or the name of a shipped one.
    out : str or Path
        Folder of the run: results.parquet, summary.json, figures/, index.html. A stopped run goes on.
    settings : mapping, optional
        Values that replace those of the file, by key path.
    command : str
        How the run was called, for the report.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        Called with realisations done, realisations in all, and the name of the setting.
    workers : int
        Processes of this machine that work at once, >= 1.
    engine : Engine, optional
        Who does the work, in place of `workers` (see `simtest.runtime.engines.make_engine`).

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the experiment is malformed, an estimator unknown, or `out` holds something else than a run.
    BackendError
        If the rendering backend cannot be used.
    """
    # Imported here: the figures' libraries are slow to load and rendering alone does not need them.
    from simtest.report import write_report
    from simtest.validation.runner import run_experiment

    described = experiment if isinstance(experiment, Experiment) else load_experiment(experiment, settings)
    run = run_experiment(described, Path(out), command, variant, progress, engine or make_engine(workers=workers))
    return write_report(run.folder)


@dataclass(frozen=True)
class Extras:
    """What else a picture is reconstructed with.

    Parameters
    ----------
    reference : Path, optional
        Mesh in mm, or a depth map, to compare with.
    pose : Path, optional
        camera_from_model of the mesh.
    depth : str, optional
        Depth of the arrows: a number in mm, or a depth map.
    depth_scale_mm : float, optional
        mm of one step of an integer depth map.
    """

    reference: Path | None = None
    pose: Path | None = None
    depth: str | None = None
    depth_scale_mm: float | None = None


def reconstruct_picture(
    image: Path,
    out: Path,
    camera_file: Path | None = None,
    fov_deg: float | None = None,
    estimators: Sequence[str] | None = None,
    roi: str | None = None,
    encoding: str | None = None,
    every: bool = False,
    detector: str = "auto",
    smoothing_px: float | None = None,
    extras: Extras | None = None,
) -> tuple[int, list[Path]]:
    """Reconstruct the normals of a picture and write them.

    Parameters
    ----------
    image : Path
        The picture.
    out : Path
        Folder, made if need be.
    camera_file : Path, optional
        Calibration or camera file; this or `fov_deg` must be given, not both.
    fov_deg : float, optional
        Horizontal field of view, deg.
    estimators : sequence of str, optional
        Names; default those of the package that need no more than the calibration states.
    roi : str, optional
        "x,y,w,h" in px; default: detected.
    encoding : {"srgb", "linear"}, optional
        How the picture's values are encoded, where the calibration does not state the response; default sRGB.
        Isophotes are those of linear values.
    every : bool
        Take peaks too that the border cuts or whose shape is not that of one point highlight.
    detector : {"auto", "colour", "peaks"}
        How highlights are found (`Options`).
    smoothing_px : float, optional
        Standard deviation of the Gaussian smoothing, px.
    extras : Extras, optional
        Reference surface and depths.

    Returns
    -------
    count : int
        Specularities found.
    files : list of Path
        normals.json, normals.csv, normals.ply, overlay.png, and the others.

    Raises
    ------
    InputError
        If the input is malformed or the folder cannot be written.
    """
    from simtest.reconstruction.image_io import read_picture
    from simtest.reconstruction.picture import NOTHING, parse_roi, picture_document, write_document
    from simtest.reconstruction.single import Options, check_camera_given, completed, read_camera
    from simtest.validation.depth_maps import depths_at
    from simtest.validation.reference_surface import comparison

    box = parse_roi(roi) if roi is not None else None
    options = Options(None if estimators is None else tuple(estimators), box, encoding, every, detector, smoothing_px)
    check_camera_given(camera_file, fov_deg)
    picture = read_picture(image)
    height, width = picture.shape[:2]
    calibration, cautions = read_camera(camera_file, fov_deg, (width, height))
    for caution in cautions:
        warnings.warn(caution, stacklevel=2)
    calibration = completed(calibration, encoding)
    reference = _reference(extras, calibration.camera)
    document = picture_document(image, picture, calibration, options, cautions)
    spots = document["specularities"]
    if not spots:
        document["warnings"].append(NOTHING)
        warnings.warn(NOTHING, stacklevel=2)
    depth = None
    if extras is not None and extras.depth is not None:
        looks = [spot["peak_px"] for spot in spots]
        depth = depths_at(extras.depth, looks, (width, height), extras.depth_scale_mm)
    if reference is not None:
        document["reference"] = comparison(spots, calibration.camera, reference)
    return len(spots), write_document(out, document, picture, calibration.camera, depth)


def _reference(extras: Extras | None, camera: "Camera") -> "Reference | None":
    from simtest.validation.reference_surface import load_reference

    if extras is None or extras.reference is None:
        if extras is not None and extras.pose is not None:
            raise InputError("--camera-from-model: needs --reference, the mesh that it places")
        return None
    return load_reference(extras.reference, extras.pose, camera, extras.depth_scale_mm)
