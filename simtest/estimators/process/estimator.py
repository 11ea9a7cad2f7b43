"""Cores as estimators: of single highlights, or of whole frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.errors import Failure
from simtest.estimators.process.answers import estimate_of, estimates_of
from simtest.estimators.process.core import Core, Hello, kept_core
from simtest.estimators.process.requests import frame_request, patch_request
from simtest.estimators.process.wire import CoreFault, Message
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch


@dataclass(frozen=True)
class _Process:
    """What both kinds share.

    Parameters
    ----------
    core : Core
        Started once at least, so that its greeting is known.
    """

    core: Core = field(repr=False)

    @property
    def description(self) -> str:
        """What the core is, in one line for a reader who chooses an estimator."""
        hello = self._hello
        version = f" {hello.version}" if hello.version else ""
        return f"A core of its own process: {hello.name}{version}, {self.core.command.text}."

    @property
    def _hello(self) -> Hello:
        assert self.core.hello is not None
        return self.core.hello

    def _ask(self, request: tuple[Mapping[str, Any], Mapping[str, npt.NDArray[Any]]]) -> Message:
        return self.core.ask(*request)


@dataclass(frozen=True)
class ProcessEstimator(_Process):
    """A core that takes single highlights."""

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Ask the core (see `simtest.estimators.Estimator`); its breakdown is a Failure ``core_...``."""
        try:
            answer = self._ask(patch_request(patch, camera, priors, self._hello))
            return estimate_of(answer, camera, self._hello)
        except CoreFault as fault:
            return Failure(fault.reason, fault.detail)


@dataclass(frozen=True)
class ProcessFrameEstimator(_Process):
    """A core that takes whole frames."""

    def estimate_frame(
        self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS
    ) -> list[Estimate | Failure] | Failure:
        """Ask the core (see `simtest.estimators.FrameEstimator`); its breakdown is a Failure ``core_...``."""
        try:
            answer = self._ask(frame_request(frame, camera, priors, self._hello))
            return estimates_of(answer, camera, self._hello)
        except CoreFault as fault:
            return Failure(fault.reason, fault.detail)


def load_core(text: str) -> ProcessEstimator | ProcessFrameEstimator:
    """Start a core, if it does not run in this process already, and return it as an estimator."""
    core = kept_core(text)
    assert core.hello is not None
    return ProcessEstimator(core) if core.hello.kind == "patch" else ProcessFrameEstimator(core)
