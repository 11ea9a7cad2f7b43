"""Validation experiments: which scenes, which swept parameters, how many realisations, which estimators."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.runtime.arrays import short_repr
from simtest.runtime.boundary import plain_errors, suggestion
from simtest.runtime.resources import find
from simtest.spec.paper import PaperScene
from simtest.spec.scene import Scene
from simtest.spec.spec_model import Name, Spec, load
from simtest.spec.type_change import rivals

LawName = Literal[
    "circle_pose", "branch_point", "axis_ratio", "axis_ratio_seen", "offset", "bisector", "falloff", "look"
]
"""Error laws of docs/concepts/theory.md, section 4, that a page compares with measured errors."""


class Uniform(Spec):
    """A uniform distribution over [low, high)."""

    low: float
    high: float

    @model_validator(mode="after")
    def _ordered(self) -> "Uniform":
        if self.low > self.high:
            raise ValueError(f"low = {self.low:g} must not exceed high = {self.high:g}")
        return self


class Group(Spec):
    """One family of settings on one base scene.

    `sweep` holds tables of equally long lists that vary together; several tables are multiplied out. `pool` is the
    same, but its values count as realisations of one setting. `random` draws a value for each realisation.
    """

    scene: str = Field(description="base scene: a shipped name or a path")
    label: str = Field("", max_length=80, description="name of the curve in the figures; default the surface's")
    set: dict[str, Any] = Field(default_factory=dict, description="values that replace the scene's, by key path")
    sweep: tuple[dict[str, tuple[Any, ...]], ...] = ()
    pool: tuple[dict[str, tuple[Any, ...]], ...] = ()
    random: dict[str, Uniform] = Field(default_factory=dict)
    realisations: int | None = Field(None, ge=1, le=10**6, description="default the experiment's")
    laws: tuple[LawName, ...] = Field(
        (),
        description="laws of docs/concepts/theory.md, section 4, that the page compares with these settings' results",
    )
    isolated: bool = Field(
        True,
        description="count isolated highlights only (theory.md section 6); false: every point where N bisects L and V",
    )

    __repr__ = short_repr
    __str__ = short_repr

    @model_validator(mode="after")
    def _equal_lengths(self) -> "Group":
        for table in (*self.sweep, *self.pool):
            lengths = {key: len(values) for key, values in table.items()}
            if not lengths or 0 in lengths.values() or len(set(lengths.values())) > 1:
                raise ValueError(f"lists of one sweep must be equally long and not empty, got lengths {lengths}")
        # Two draws of one key would overwrite each other.
        keys = [key for table in (*self.sweep, *self.pool) for key in table] + list(self.random)
        if twice := next((key for key in keys if keys.count(key) > 1), None):
            raise ValueError(f"{twice}: varied twice; a key may be in one table of sweep, pool and random")
        return self


class Experiment(Spec):
    """A validation experiment.

    Examples
    --------
    >>> import simtest
    >>> experiment = simtest.load_experiment("overview")
    >>> experiment.name, "cone_axis" in experiment.estimators
    ('overview', True)
    """

    name: Name
    title: str = ""
    description: str = ""
    realisations: int = Field(20, ge=1, le=10**6)
    seed: int = Field(0, ge=0, lt=2**63)
    estimators: tuple[str, ...] = Field(("circle_pose", "brightest_point", "cone_axis"), min_length=1)
    groups: tuple[Group, ...] = Field(min_length=1)

    __repr__ = short_repr
    __str__ = short_repr


VIEWPOINT = "surface.viewpoint"
OWN_KEYS = ("description", "estimators", "realisations", "seed", "title", "viewpoints")
"""Settings of the experiment itself; all others are keys of its scenes."""


@plain_errors
def load_experiment(name: str | Path, settings: Mapping[str, Any] | None = None) -> Experiment:
    """Read an experiment file.

    Parameters
    ----------
    name : str or Path
        A path, or the name of a shipped experiment.
    settings : mapping, optional
        Values by key path. The experiment's own keys (realisations, seed, estimators) are replaced, realisations in all
        groups; `viewpoints` keeps that many of them, the first ones, of each group that varies them; all other paths
        are those of the scene and apply to each group, in place of a sweep over them.

    Raises
    ------
    InputError
        If the file is missing or malformed.

    Examples
    --------
    >>> import simtest
    >>> simtest.load_experiment("overview", {"realisations": 3}).realisations
    3
    """
    path = find(name, "scenes", "experiments")
    # The experiment's own keys; all others are keys of the scenes.
    settings = dict(settings or {})
    own = {key: settings.pop(key) for key in list(settings) if key in OWN_KEYS}
    viewpoints = own.pop("viewpoints", None)
    changes = [f"{key}={value}" for key, value in settings.items()]
    check_first_parts(settings, [*Scene.model_fields, *PaperScene.model_fields], OWN_KEYS)
    experiment = load(Experiment, path, own)
    groups = tuple(_override(group, settings) for group in experiment.groups)
    if viewpoints is not None:
        groups = tuple(_thinned(group, viewpoints) for group in groups)
        if not any(VIEWPOINT in table for group in groups for table in (*group.sweep, *group.pool)):
            raise InputError(f"--set viewpoints: no group of {path} varies {VIEWPOINT}")
    if "realisations" in own:
        # In all groups, also in those that have a number of their own.
        groups = tuple(group.model_copy(update={"realisations": None}) for group in groups)
    # The page must say that this is not the experiment as shipped.
    description = experiment.description
    if changes:
        description = f"{description} With {', '.join(changes)}.".strip()
    if viewpoints is not None:
        kept = "the first viewpoint" if viewpoints == 1 else f"the first {viewpoints} viewpoints"
        description = f"{description} Cut down by viewpoints={viewpoints}: at most {kept} of each setting.".strip()
    return experiment.model_copy(update={"groups": groups, "description": description})


def check_first_parts(settings: Mapping[str, Any], scene: Iterable[str], own: Iterable[str]) -> None:
    """Raise `InputError` for a key path that begins with no key of the scenes; `own` are those of what holds them."""
    scene, own = dict.fromkeys(scene), sorted(own)
    for path in settings:
        first = path.partition(".")[0]
        if first not in scene:
            allowed = f"allowed: {', '.join(own)}, and of the scenes {', '.join(scene)}"
            raise InputError(f"--set {path}: unknown key; {allowed}{suggestion(first, [*own, *scene])}")


def still_varied(varied: Iterable[str], settings: Mapping[str, Any], what: str) -> set[str]:
    """Return which of the key paths that an experiment or a dataset varies stay so beside settings.

    A setting fixes its path, all below it and the keys that it excludes. Raises `InputError` for a part of a value that
    is varied as a whole.
    """
    left = dict.fromkeys(varied)
    for path in settings:
        if whole := next((key for key in left if path.startswith(f"{key}.")), None):
            raise InputError(f"--set {path}: the {what} varies {whole} as a whole; set {whole} itself instead")
    return {key for key in left if not _is_replaced(key, settings)}


def replaced(values: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by key path, with settings in place of those that they fix."""
    return {**{key: value for key, value in values.items() if not _is_replaced(key, settings)}, **settings}


def _is_replaced(key: str, settings: Mapping[str, Any]) -> bool:
    """Return whether a key path is one that settings fix: theirs, one below it, or one that it excludes."""
    fixed = (each for path in settings for each in (path, *rivals(path)))
    return any(f"{key}.".startswith(f"{path}.") for path in fixed)


def _thinned(group: Group, count: object) -> Group:
    """Keep the first viewpoints of a group that varies them."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"--set viewpoints={count!s}: must be a whole number from 1 on")

    def first(tables: tuple[dict[str, tuple[Any, ...]], ...]) -> tuple[dict[str, tuple[Any, ...]], ...]:
        return tuple(
            {key: values[:count] for key, values in table.items()} if VIEWPOINT in table else table for table in tables
        )

    return group.model_copy(update={"sweep": first(group.sweep), "pool": first(group.pool)})


def _override(group: Group, settings: Mapping[str, Any]) -> Group:
    """Fix scene values in a group; swept and random values of the same path, or below it, are dropped."""
    varied = [*group.random, *(key for table in (*group.sweep, *group.pool) for key in table)]
    kept = still_varied(varied, settings, "experiment")

    def without(tables: tuple[dict[str, tuple[Any, ...]], ...]) -> tuple[dict[str, tuple[Any, ...]], ...]:
        thinned = ({key: values for key, values in table.items() if key in kept} for table in tables)
        return tuple(table for table in thinned if table)

    return group.model_copy(
        update={
            "set": replaced(group.set, settings),
            "sweep": without(group.sweep),
            "pool": without(group.pool),
            "random": {key: value for key, value in group.random.items() if key in kept},
        }
    )
