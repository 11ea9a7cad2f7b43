"""Profiles of the nightly: a fixed list of experiments, and how much of each is run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.spec.experiment import Experiment, Group, load_experiment
from simtest.spec.spec_model import Name, Spec, load


class ProfileEntry(Spec):
    """One experiment of a night."""

    experiment: str = Field(min_length=1, description="a shipped name, or a path; relative ones start at the profile")
    name: Name | None = Field(
        None, description="name in the results, where one experiment is run twice; seeds hang on it"
    )
    realisations: int | None = Field(None, ge=1, le=10**6, description="of each setting, in place of the experiment's")
    pool: int | None = Field(
        None, ge=1, description="how many pooled values (an anatomy's viewpoints) of each setting are kept, at most"
    )
    seed: int | None = Field(None, ge=0, lt=2**63, description="in place of the experiment's")
    estimators: tuple[str, ...] | None = Field(None, min_length=1, description="in place of the experiment's")
    labels: tuple[str, ...] | None = Field(None, min_length=1, description="groups that are run, by label; default all")
    set: dict[str, Any] = Field(default_factory=dict, description="values that replace the scenes', by key path")


class Profile(Spec):
    """What a night runs."""

    name: Name
    title: str = ""
    description: str = ""
    experiments: tuple[ProfileEntry, ...] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _told_apart(self) -> "Profile":
        names = [entry.name or Path(entry.experiment).stem for entry in self.experiments]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"experiment {twice}: listed twice; give one of them another name")
        return self


def load_profile(name: str | Path) -> Profile:
    """Read a profile, by its path or the name of a shipped one; the paths of its experiments become absolute.

    Raises `InputError` if the file is missing or malformed.
    """
    path = find(name, "scenes", "profiles")
    profile = load(Profile, path)
    entries = (
        entry.model_copy(update={"experiment": _beside(path, entry.experiment)}) for entry in profile.experiments
    )
    return profile.model_copy(update={"experiments": tuple(entries)})


def _beside(profile: Path, experiment: str) -> str:
    """Return the path of an experiment that lies beside its profile; any other name as it is."""
    path = profile.resolve().parent / experiment
    return str(path) if path.is_file() else experiment


def experiments_of(profile: Profile) -> list[Experiment]:
    """Read a profile's experiments, reduced as it demands.

    Raises `InputError` if one is missing or malformed, or has no group of a demanded label.
    """
    return [_experiment(profile, entry) for entry in profile.experiments]


def _experiment(profile: Profile, entry: ProfileEntry) -> Experiment:
    own = {"realisations": entry.realisations, "seed": entry.seed, "estimators": entry.estimators}
    values: Mapping[str, Any] = {key: value for key, value in own.items() if value is not None}
    experiment = load_experiment(entry.experiment, {**values, **entry.set})
    groups = experiment.groups
    # the groups asked for
    if entry.labels is not None:
        labels = [group.label for group in groups]
        if missing := next((label for label in entry.labels if label not in labels), None):
            allowed = ", ".join(str(label) for label in labels if label)
            raise InputError(f"profile {profile.name}: {experiment.name} has no group {missing!r}; allowed: {allowed}")
        groups = tuple(group for group in groups if group.label in entry.labels)
    # the first viewpoints of each
    if entry.pool is not None:
        groups = tuple(_thinned(group, entry.pool) for group in groups)
    return experiment.model_copy(update={"groups": groups, "name": entry.name or experiment.name})


def _thinned(group: Group, count: int) -> Group:
    """Keep the first pooled values of a group: each value's seed depends on its index."""
    pool = tuple({key: values[:count] for key, values in table.items()} for table in group.pool)
    return group.model_copy(update={"pool": pool})
