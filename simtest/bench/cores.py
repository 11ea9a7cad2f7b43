"""What a certificate tells of a core: its name, its version, and hashes of its files; and how long a request takes."""

import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simtest.bench.draws import Seeds, experiment_of
from simtest.bench.suite import Suite, digest_of
from simtest.calibration import Frame, Priors
from simtest.errors import Failure, InputError
from simtest.estimators import AnyEstimator, Estimate, load_estimators
from simtest.estimators.installed import ESTIMATORS
from simtest.estimators.process.command import INTERPRETERS, parse_core
from simtest.estimators.process.naming import core_hashes, core_records, has_files, short_name
from simtest.estimators.protocol import BatchEstimator, Estimator
from simtest.geometry import Camera, Patch
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime.files import Json, JsonObject
from simtest.runtime.model_names import parse_model
from simtest.validation.cases import expand
from simtest.validation.realisation import Realiser

TIMED_FRAMES = 4
"""Frames whose requests are timed; the first, which loads what is needed, does not count."""


def load_core(text: str) -> tuple[str, AnyEstimator]:
    """Load a core by its name or command; return it with the name that its results bear."""
    found = load_estimators([text])
    return next(iter(found.items()))


def core_record(text: str) -> JsonObject:
    """Return what a certificate tells of a core, without paths.

    `sha256` is of the core's own files and of the words of its command. An interpreter or another program of the
    machine, such as docker, is no part of it, since it differs from machine to machine: it stands under `program`.
    Modules that a script loads are seen only where the command or the TOML file (`core.files`) names them.

    Raises
    ------
    InputError
        If it is unknown or cannot be started.
    """
    name, _ = load_core(text)
    if not has_files(text):
        ((_, package),) = ESTIMATORS.distributions([text]).items()
        return {"name": name, "kind": "installed", "version": package, "sha256": None}
    if parse_model(text):
        ((_, package),) = ESTIMATORS.distributions([text]).items()
        (digest,) = core_hashes([text])[text].values()
        return {"name": name, "kind": "network", "version": package, "sha256": digest}
    (record,) = core_records([text]).values()
    ((_, hashes),) = core_hashes([text]).items()
    (program, digest), *files = hashes.items()
    own = files if _is_shared(Path(program)) else [(program, digest), *files]
    # Files by name, without folders: the same core lies elsewhere on another machine.
    named: Json = sorted([Path(file).name, of_file] for file, of_file in own)
    version = record.get("version")
    return {
        "name": short_name(text), "kind": "command", "version": None if version is None else str(version),
        "sha256": digest_of({"files": named, "words": _words(parse_core(text).arguments[1:])}),
        "program": {"name": Path(program).name, "sha256": digest},
    }  # fmt: skip


def _words(arguments: Sequence[str]) -> list[str]:
    """Return the words of a command as they are on every machine: paths without their folders."""
    words = []
    for word in arguments:
        option, equals, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
        words.append(f"{option}{equals}{Path(value).name if value.startswith('/') else value}")
    return words


def _is_shared(program: Path) -> bool:
    """Return whether a program belongs to the machine, not to the core: an interpreter, or one that is on PATH."""
    found = shutil.which(program.name)
    return bool(INTERPRETERS.match(program.name)) or (found is not None and os.path.abspath(found) == str(program))


class _Timed:
    """An estimator whose requests are timed, s."""

    def __init__(self, inner: AnyEstimator) -> None:
        self.inner, self.taken = inner, list[float]()

    def keep(self, started: float, requests: int = 1) -> None:
        self.taken += [(time.perf_counter() - started) / max(requests, 1)] * requests


class _TimedPatches(_Timed):
    def estimate(self, patch: Patch, camera: Camera, priors: Priors, /) -> Estimate | Failure:
        assert isinstance(self.inner, Estimator)
        started = time.perf_counter()
        made = self.inner.estimate(patch, camera, priors)
        self.keep(started)
        return made


class _TimedBatches(_TimedPatches):
    def estimate_batch(
        self, patches: Sequence[Patch], camera: Camera, priors: Priors, /
    ) -> Sequence[Estimate | Failure]:
        assert isinstance(self.inner, BatchEstimator)
        started = time.perf_counter()
        made = self.inner.estimate_batch(patches, camera, priors)
        self.keep(started, len(patches))
        return made


class _TimedFrames(_Timed):
    def estimate_frame(self, frame: Frame, camera: Camera, priors: Priors, /) -> Sequence[Estimate] | Failure:
        assert not isinstance(self.inner, Estimator)
        started = time.perf_counter()
        made = self.inner.estimate_frame(frame, camera, priors)
        self.keep(started)
        return made


def time_core(suite: Suite, part: str, text: str, seeds: Seeds, variant: str | None = None) -> JsonObject:
    """Measure how long a request takes, in this process, on frames of a part.

    Returns
    -------
    dict
        Unit of a request (highlight or frame), how many were timed, and their median and largest time, ms. They are
        of this machine, and no part of what a certificate's verification compares.
    """
    name, core = load_core(text)
    timed: _Timed
    if not isinstance(core, Estimator):
        timed = _TimedFrames(core)
    else:
        timed = _TimedBatches(core) if isinstance(core, BatchEstimator) else _TimedPatches(core)
    experiment = experiment_of(suite, part, text, seeds)
    every = expand(experiment)
    realiser = Realiser(variant)
    for count, case in enumerate(every[:: max(1, len(every) // TIMED_FRAMES)][:TIMED_FRAMES]):
        number = case.numbers()[0]
        view = realiser.make(experiment, case, number, {}).view
        if count == 1:
            timed.taken.clear()
        frame = view.frame(case.noise_seed(experiment, number))
        reconstruct(frame, view.calibration, {name: timed}, isolated=case.isolated)
    unit = "highlight" if isinstance(core, Estimator) else "frame"
    if not timed.taken:
        return {"unit": unit, "n": 0, "median_ms": None, "max_ms": None}
    ms = [round(1e3 * float(figure), 4) for figure in (np.median(timed.taken), max(timed.taken))]
    return {"unit": unit, "n": len(timed.taken), "median_ms": ms[0], "max_ms": ms[1]}


def check_core(text: str) -> None:
    """Raise `InputError` for an empty core, before anything is read."""
    if not text.strip():
        raise InputError('--core: is empty; must be an installed estimator, or a command as in "command: ./core"')
