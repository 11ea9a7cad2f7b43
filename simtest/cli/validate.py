"""`simtest validate`."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.options import (
    Address,
    EngineName,
    Estimators,
    Realisations,
    Seed,
    Settings,
    Variant,
    Workers,
    named_path,
)

DEFAULT_OUT = Path("reports/runs")


def validate(
    experiment: str,
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Folder of the run; default reports/runs/EXPERIMENT.", converter=named_path)
    ] = None,
    realisations: Realisations = None,
    seed: Seed = None,
    settings: Settings = None,
    estimators: Estimators = None,
    variant: Variant = None,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
) -> None:
    """Run an experiment and write results.parquet, summary.json, figures and index.html; a stopped run goes on.

    Parameters
    ----------
    experiment : str
        An experiment file, or the name of a shipped one: overview, curvature, light_offset, grid, laws, compare,
        known_light, sensor, reflectance, relief, interreflection, rig, camera, anatomy, anatomy_sensor, colon, liver,
        mesh, paper, paper_limits.
    """
    from simtest.api import validate as run
    from simtest.cli.guide_table import print_guide
    from simtest.cli.progress import progress_bar
    from simtest.rendering.backend import needs_gpu
    from simtest.runtime.engines import make_engine
    from simtest.spec import load_experiment, parse_settings

    values = parse_settings(settings or [])
    own = {"realisations": realisations, "seed": seed, "estimators": estimators}
    values |= {key: value for key, value in own.items() if value is not None}
    described = load_experiment(experiment, values)
    command = shlex.join(["simtest", *sys.argv[1:]])
    with progress_bar() as progress:
        folder = out or DEFAULT_OUT / described.name
        chosen = make_engine(engine, workers, address, gpu=needs_gpu(variant))
        run(described, folder, command=command, variant=variant, progress=progress, engine=chosen)
    print_guide(folder)
    print(folder / "index.html")
