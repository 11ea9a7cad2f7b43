"""What a run works on: an experiment with its cases, the folder that it is run in, and its Mitsuba variant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from simtest.rendering import backend
from simtest.spec import Experiment
from simtest.validation.cases import Case, expand
from simtest.validation.fingerprints import fingerprint
from simtest.validation.run_folder import PARTS, part_file


@dataclass(frozen=True)
class Job:
    """An experiment with the folder that it is run in.

    Parameters
    ----------
    experiment : Experiment
        What is run.
    folder : Path
        Of the run.
    cases : list of Case
        The experiment's.
    variant : str
        Mitsuba variant of all its cases.
    digest : str
        Hash of everything that determines the results.
    """

    experiment: Experiment
    folder: Path
    cases: list[Case]
    variant: str
    digest: str

    def missing(self) -> list[int]:
        """Return the indices of the cases that are not done yet."""
        return [index for index in range(len(self.cases)) if not part_file(self.folder / PARTS, index).exists()]


def make_jobs(wanted: Sequence[tuple[Experiment, Path]], variant: str | None) -> list[Job]:
    """Expand experiments, each paired with its folder, and choose the variant of each."""
    jobs = []
    for experiment, folder in wanted:
        cases = expand(experiment)
        # Chosen here: a worker on another machine may have another environment.
        own = variant_of(cases, variant)
        jobs.append(Job(experiment, folder, cases, own, fingerprint(experiment, cases, own)))
    return jobs


def variant_of(cases: Sequence[Case], variant: str | None = None) -> str:
    """Return the Mitsuba variant of an experiment, given that which was asked for (see `backend.requested_variant`).

    The variant depends on the experiment's own scenes alone, never on the other experiments of a run: in a colour
    variant even a grey scene has three channels, each with its own noise, and their mean is less noisy.
    """
    return backend.requested_variant(variant, coloured=any(case.is_coloured for case in cases))
