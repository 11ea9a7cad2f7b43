"""Hashes of what determines a run's results, and of what an experiment is."""

import hashlib
import json
from pathlib import Path

from simtest.estimators.names import ESTIMATORS, core_hashes
from simtest.runtime import provenance
from simtest.runtime.files import Json
from simtest.spec import Experiment
from simtest.spec.surfaces import AnatomySurface
from simtest.validation.cases import Case


def fingerprint(experiment: Experiment, cases: list[Case], variant: str) -> str:
    """Return a hash of everything that determines a run's results."""
    return _hash(
        {
            "experiment": experiment.model_dump(mode="json"),
            "scenes": [case.data for case in cases],
            "inputs": input_hashes(cases) | region_hashes(experiment),
            "versions": provenance.versions() | ESTIMATORS.distributions(experiment.estimators),
            "cores": core_hashes(experiment.estimators),
            "source": provenance.source_hash(),
            "variant": variant,
        }
    )


def definition(experiment: Experiment, cases: list[Case]) -> str:
    """Return a hash of what an experiment is: itself, its scenes and input files; not code, versions, paths, prose."""
    # Names without folders: a moved checkout holds the same experiments.
    files = sorted((Path(name).name, digest) for name, digest in input_hashes(cases).items())
    scenes = [case.data for case in cases]
    itself = experiment.model_dump(mode="json", exclude={"title", "description"})
    return _hash({"experiment": itself, "scenes": scenes, "inputs": files})


def region_hashes(experiment: Experiment) -> dict[str, str]:
    """Return the hashes of the calibrations by which answers get regions."""
    files = () if experiment.regions is None else experiment.regions.files
    return {file: provenance.file_hash(Path(file)) for file in files}


def _hash(content: Json) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def input_hashes(cases: list[Case]) -> dict[str, str]:
    """Return the hashes of the files that the cases were read from."""
    files = {Path(case.where) for case in cases}
    for case in cases:
        surface = case.data.get("surface", {})
        # Meshes and recipes.
        if surface.get("type") == "anatomy":
            files.add(AnatomySurface.model_validate(surface).file())
    return {str(file): provenance.file_hash(file) for file in sorted(files) if file.is_file()}
