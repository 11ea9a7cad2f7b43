"""The workflows behind the commands: render a labelled frame, run an experiment with its report, reconstruct a file.

Each imports what it needs when it is called: the renderer, the figures and SciPy are slow to load, and no workflow
needs them all.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simtest.errors import InputError
from simtest.runtime.boundary import plain, plain_errors
from simtest.runtime.files import as_path, check_count
from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.reconstruction import reconstruct
    from simtest.reconstruction.options import Options
    from simtest.reconstruction.records import Specularities
    from simtest.report.run_results import RunResults
    from simtest.runtime.processes import Engine
    from simtest.simulation.frame import LabelledFrame
    from simtest.simulation.views import SampledViews
    from simtest.spec import Experiment, Scene
    from simtest.validation.runner import Progress

__getattr__, *_ = lazy_names(__name__)

__all__ = [
    "Extras",
    "LabelledFrame",
    "RunResults",
    "export",
    "reconstruct",
    "reconstruct_picture",
    "render",
    "sample_views",
    "validate",
]

MOST_VIEWS = 1000

TRIES = 10
"""Viewpoints that are tried for each view wanted."""


@plain_errors
def render(
    scene: "Scene | str | Path",
    settings: Mapping[str, Any] | None = None,
    variant: str | None = None,
    progress: "Progress | None" = None,
    **overrides: Any,
) -> "LabelledFrame":
    """Render a scene with its ground truth.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a scene file, or the name of a shipped scene.
    settings : mapping, optional
        Values that replace those of the scene, by key path, such as ``{"surface.radius_mm": 5.0}``.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        Called with samples done, samples in all, and what is done; what it raises stops the frame.
    **overrides
        Values by the last name of a key, such as ``radius_mm=5.0``, where one key alone ends so. Keys that the scene's
        file states come first, then those that it leaves at their defaults.

    Returns
    -------
    LabelledFrame

    Raises
    ------
    InputError
        If the scene is malformed, the camera sees no surface, or several keys or none end in the name of an override.
    BackendError
        If the rendering backend cannot be used.

    Examples
    --------
    >>> import simtest
    >>> frame = simtest.render("cylinder", radius_mm=5.0, width=96, height=96)
    >>> frame.image.shape, [truth.isolated for truth in frame.highlights]
    ((96, 96), [True])
    """
    from simtest.simulation.frame import make_frame

    return make_frame(_scene(scene, settings, overrides), variant, progress)


@plain_errors
def export(
    scene: "Scene | str | Path",
    out: str | Path,
    settings: Mapping[str, Any] | None = None,
    variant: str | None = None,
    **overrides: Any,
) -> list[Path]:
    """Write a scene as files that Mitsuba itself loads: scene.xml, and surface.ply where the surface is a mesh.

    Parameters
    ----------
    scene, settings, **overrides
        As of `render`.
    out : str or Path
        Folder, made if need be.
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

    Examples
    --------
    >>> import simtest, tempfile
    >>> [file.name for file in simtest.export("sphere", tempfile.mkdtemp())]
    ['scene.xml']
    """
    from simtest.rendering.mitsuba_export import export_scene
    from simtest.runtime.locks import exclusive_folder

    folder = as_path(out, "out")
    with exclusive_folder(folder):
        return export_scene(_scene(scene, settings, overrides), folder, variant)


@plain_errors
def sample_views(
    scene: "Scene | str | Path",
    out: str | Path,
    count: int = 50,
    settings: Mapping[str, Any] | None = None,
    variant: str | None = None,
    progress: "Progress | None" = None,
    along: tuple[float, float] | None = None,
    fps: float | None = None,
    labels: bool = False,
) -> "SampledViews":
    """Pick viewpoints of an anatomy that show isolated highlights, or follow its camera path (docs/howto/scenes.md).

    At most ten viewpoints are tried for each view wanted. `along` are the first and last share of the camera path: a
    sequence of `count` views evenly spaced between them, at `fps` frames a second (default 25), with optical flow and
    co-visibility where `labels`. The folder gets views.json, pictures, sheet.png, and the poses for other programs.
    """
    from simtest.runtime.locks import exclusive_folder
    from simtest.simulation.views import along_path, candidates, sample_into

    check_count(count, "count", MOST_VIEWS)
    described = _scene(scene, settings, {})
    viewpoints = candidates(described, TRIES * count) if along is None else along_path(described, count, *along)
    if along is None and (fps is not None or labels):
        raise InputError(f"{'labels' if labels else 'fps'}: needs along, a sequence of views")
    folder = as_path(out, "out")
    with exclusive_folder(folder):
        return sample_into(folder, described, count, viewpoints, variant, progress, along is not None, fps, labels)


@plain_errors
def validate(
    experiment: "Experiment | str | Path",
    out: str | Path,
    settings: Mapping[str, Any] | None = None,
    command: str = "",
    variant: str | None = None,
    progress: "Progress | None" = None,
    workers: int = 1,
    engine: "Engine | None" = None,
    export: str | Path | None = None,
    charts: bool = False,
    **overrides: Any,
) -> "RunResults":
    """Run an experiment and write its report.

    Parameters
    ----------
    experiment : Experiment, str or Path
        An experiment, its file, or the name of a shipped one.
    out : str or Path
        Folder of the run: results.parquet, summary.json, guide.json, figures/, index.html. A stopped run goes on.
    settings : mapping, optional
        Values that replace those of the experiment's file and scenes, by key path.
    command : str
        How the run was called, for the report.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        Called with realisations done, realisations in all, and the name of the setting.
    workers : int
        Processes of this machine that work at once, >= 1.
    engine : Engine, optional
        What runs the work, in place of `workers` (see `simtest.runtime.processes.make_engine`).
    export : str or Path, optional
        Folder for the frames without their truth, for methods that run elsewhere (docs/howto/scoring.md).
    charts : bool
        Whether the charts of the page are written as PNG files too.
    **overrides
        Values by the last name of a key of the experiment, such as ``realisations=5``, or of its scenes.

    Returns
    -------
    RunResults
        The table, the summary and the page, read when they are asked for.

    Raises
    ------
    InputError
        If the experiment is malformed, an estimator unknown, or `out` holds something else than a run.
    BackendError
        If the rendering backend cannot be used.

    Warns
    -----
    RuntimeWarning
        Of each error inside an estimator or a core, once, with its text and the number of highlights that it cost.

    Examples
    --------
    >>> import simtest, tempfile
    >>> out = tempfile.mkdtemp()
    >>> run = simtest.validate("paper", out, realisations=1, size=64, estimators=["cone_axis"])
    >>> run.page.name, run.results["estimator"].unique().to_list()
    ('index.html', ['cone_axis'])
    """
    from simtest.estimators.names import close_cores
    from simtest.runtime.locks import exclusive_folder
    from simtest.runtime.processes import make_engine

    described = _experiment(experiment, settings, overrides)
    chosen = engine or make_engine(workers=workers)
    folder, frames = as_path(out, "out"), None if export is None else as_path(export, "export")
    with exclusive_folder(folder):
        try:
            made = _run_and_report(described, folder, command, variant, progress, chosen, frames, charts)
            made.warn_of_faults()
            return made
        except OSError as error:
            kept = "what is finished is kept, and the same command goes on from there"
            raise plain(error, kept, folder) from error
        finally:
            # The page's worst cases are estimated again.
            close_cores()


def _run_and_report(
    experiment: "Experiment", out: Path, command: str, variant: str | None, progress: "Progress | None",
    engine: "Engine", export: Path | None, charts: bool,
) -> "RunResults":  # fmt: skip
    """Run an experiment, write its page, and export its frames where a folder for them is given."""
    from simtest.report import write_report
    from simtest.report.run_results import RunResults
    from simtest.validation.runner import run_experiment

    if export is not None:
        from simtest.dataset.export import check_export, export_run

        # Before the work.
        check_export(experiment, out, export)
    run = run_experiment(experiment, out, command, variant, progress, engine)
    page = write_report(run.folder, progress, charts)
    if export is not None:
        export_run(run.folder, experiment, export, engine, progress)
    return RunResults(page)


def _scene(scene: "Scene | str | Path", settings: Mapping[str, Any] | None, overrides: Mapping[str, Any]) -> "Scene":
    """Return the described scene with values replaced, by key path and by the last name of a key."""
    from simtest.spec import Scene, load_scene
    from simtest.spec.keys import full_keys, replace_values
    from simtest.spec.scene import scene_from_dict, without_presets
    from simtest.spec.toml_files import as_settings

    def replaced(values: dict[str, Any]) -> Scene:
        if not isinstance(scene, Scene):
            return load_scene(scene, values)
        if not values:
            return scene
        data = without_presets(scene.model_dump(mode="json", exclude_unset=True), values)
        return scene_from_dict(replace_values(Scene, data, values, "scene"))

    described = replaced(values := as_settings(settings))
    if not overrides:
        return described
    # The keys are those of the scene with its settings, so that a new type's keys have short names too.
    return replaced(values | full_keys([described], overrides))


def _experiment(
    experiment: "Experiment | str | Path", settings: Mapping[str, Any] | None, overrides: Mapping[str, Any]
) -> "Experiment":
    """Return the described experiment with values replaced; those of an `Experiment` are its own already."""
    from simtest.spec import Experiment, load_experiment
    from simtest.spec.recipes import OWN_KEYS
    from simtest.spec.toml_files import as_settings

    if isinstance(experiment, Experiment):
        if settings or overrides:
            raise InputError("settings: the experiment is given as an object; change it, or name its file")
        return experiment
    values = as_settings(settings)
    described = load_experiment(experiment, values)
    if not overrides:
        return described
    # The experiment's own keys come before those of its scenes.
    values |= {name: value for name, value in overrides.items() if name in OWN_KEYS}
    if rest := {name: value for name, value in overrides.items() if name not in OWN_KEYS}:
        from simtest.spec.keys import full_keys
        from simtest.spec.recipes import scene_models

        values |= full_keys(scene_models(described), rest, OWN_KEYS)
    return load_experiment(experiment, values)


@dataclass(frozen=True)
class Extras:
    """What else a picture is reconstructed with; the command line prints these texts as its help.

    Parameters
    ----------
    reference : Path, optional
        Mesh in mm, or depth map, that the normals are compared with.
    reference_format : str, optional
        Data set whose map the reference is: c3vd, simcol3d, ucl or endoslam.
    camera_from_model : Path, optional
        Pose of the reference mesh: TOML with matrix, or rotation and translation_mm.
    depth : str, optional
        Depth at which the points of normals.ply stand: mm, or a depth map; default 1.
    depth_scale : float, optional
        mm of one step of an integer depth map.
    """

    reference: Path | None = None
    reference_format: str | None = None
    camera_from_model: Path | None = None
    depth: str | None = None
    depth_scale: float | None = None


@plain_errors
def reconstruct_picture(
    image: Path, out: Path, options: "Options", extras: Extras | None = None
) -> tuple["Specularities", list[Path]]:
    """Reconstruct the normals of a picture and write them; return what was found, and the files."""
    from simtest.runtime.locks import exclusive_folder

    with exclusive_folder(out):
        return _reconstruct_picture(image, out, options, extras or Extras())


def _reconstruct_picture(
    image: Path, out: Path, options: "Options", extras: Extras
) -> tuple["Specularities", list[Path]]:
    from simtest.reconstruction.images import read_picture
    from simtest.reconstruction.options import calibration_for
    from simtest.reconstruction.outputs import write_outputs
    from simtest.reconstruction.pipeline import NOTHING, reconstruct_values

    # read
    picture = read_picture(image)
    calibration, cautions = calibration_for(options, picture)
    for caution in cautions:
        warnings.warn(caution, stacklevel=2)
    reference = None
    if (extras.reference, extras.camera_from_model, extras.reference_format) != (None, None, None):
        from simtest.validation.references import load_reference

        reference = load_reference(
            extras.reference, extras.camera_from_model, calibration.camera, extras.depth_scale, extras.reference_format
        )
    # linear light, detect, estimate
    found = reconstruct_values(str(image), picture, calibration, options, cautions)
    if not found:
        warnings.warn(NOTHING, stacklevel=2)
        found.warnings.append(NOTHING)
    depth = None
    if extras.depth is not None:
        from simtest.validation.depth_maps import depths_at

        peaks = [spot.peak_px for spot in found]
        depth = depths_at(extras.depth, peaks, (picture.shape[1], picture.shape[0]), extras.depth_scale)
    if reference is not None:
        from simtest.validation.references import compare

        compare(found, reference)
    # write
    return found, write_outputs(out, found, picture, depth)
