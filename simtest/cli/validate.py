"""`simtest validate`."""

import shlex
import sys
import warnings
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.manners import MANNERS
from simtest.cli.options import (
    Address,
    AsJson,
    EngineName,
    Estimators,
    Realisations,
    Seed,
    Settings,
    Variant,
    Views,
    Workers,
    named,
    named_path,
)

DEFAULT_OUT = Path("reports/runs")
MESHES = (".ply", ".obj", ".stl", ".vtk")
"""Suffixes of files that may be taken for an experiment by mistake."""


def validate(
    experiment: Annotated[str, named("experiments", files=True)],
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Folder of the run; default reports/runs/EXPERIMENT.", converter=named_path)
    ] = None,
    realisations: Realisations = None,
    seed: Seed = None,
    views: Views = None,
    settings: Settings = None,
    estimators: Estimators = None,
    variant: Variant = None,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    export: Annotated[
        Path | None,
        Parameter(help="Folder for the frames without their truth, for methods elsewhere.", converter=named_path),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run an experiment and write results.parquet, summary.json, figures and index.html; a stopped run goes on.

    Parameters
    ----------
    experiment : str
        An experiment file, or the name of a shipped one: overview, curvature, light_offset, grid, laws, compare,
        known_light, sensor, reflectance, relief, interreflection, rig, camera, motion, anatomy, anatomy_sensor, dense,
        colon, liver, mesh, paper, paper_limits.
    """
    from simtest.api import validate as run
    from simtest.cli.guide_table import print_guide
    from simtest.cli.printing import print_run
    from simtest.cli.progress import progress_bar
    from simtest.errors import InputError
    from simtest.rendering.backend import needs_gpu
    from simtest.runtime.processes import make_engine
    from simtest.spec import load_experiment, parse_settings
    from simtest.validation.mesh_verdicts import mesh_verdicts

    if Path(experiment).suffix.lower() in MESHES:
        raise InputError(f"{experiment}: is a mesh; use simtest validate mesh --set surface.path={experiment}")
    values = parse_settings(settings or [])
    own = {"realisations": realisations, "seed": seed, "estimators": estimators, "viewpoints": views}
    values |= {key: value for key, value in own.items() if value is not None}
    described = load_experiment(experiment, values)
    meshes = mesh_verdicts(described)
    for mesh in meshes:
        if not mesh.usable:
            # Before the work: it takes long, and its figures may mean nothing.
            warnings.warn(str(mesh), stacklevel=1)
    command = shlex.join(["simtest", *sys.argv[1:]])
    with progress_bar() as progress:
        folder = out or DEFAULT_OUT / described.name
        chosen = make_engine(engine, workers, address, gpu=needs_gpu(variant))
        run(described, folder, None, command, variant, progress, engine=chosen, export=export)
    if as_json:
        exported = {} if export is None else {"export": export / "README.md"}
        print_run(folder, meshes=meshes, **exported)
        return
    # A warning has told what is wrong with a mesh, unless --quiet left it out.
    verdicts = [mesh for mesh in meshes if mesh.usable or MANNERS.quiet]
    print(*verdicts, sep="\n", end="\n" * bool(verdicts))
    print_guide(folder)
    print(folder / "index.html")
    if export is not None:
        print(export / "README.md")
