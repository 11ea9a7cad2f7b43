"""What is made of scenes: experiments, datasets, profiles of nightly runs, and the published protocol.

An experiment says which scenes are rendered, which parameters vary, how often, and which estimators answer. A dataset
says which anatomies there are and what is drawn for each of them and for each sample. A profile lists experiments. The
published protocol is a kind of scene: a table ``[paper]`` in place of surface, rig and camera.
"""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, model_validator

from simtest.conventions import PAPER_SMOOTHING_PX
from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array, short_repr
from simtest.runtime.boundary import plain_errors, suggestion
from simtest.runtime.resources import find
from simtest.spec.keys import replace_values, rivals
from simtest.spec.scene import Scene
from simtest.spec.spec_model import UNSAID, Name, Share, Spec, load, validate
from simtest.spec.toml_files import as_settings, read_toml


class PaperSetting(Spec):
    """One setting of the published protocol [MB, section 3.1]; the defaults are the article's."""

    eps: float = Field(0.0, ge=0, le=1e6, description="light offset, texture units: L = V + eps (cos a, sin a, b)")
    size: int = Field(406, ge=16, le=4096, description="M: px and texture samples along a side")
    height: float = Field(1000.0, gt=0, le=1e6, description="V_Z, texture units")
    exponent: float = Field(50.0, gt=0, le=1e5, description="roughness exponent n")
    sigma: float = Field(0.05, ge=0, le=1, description="standard deviation of the noise, share of the noise-free peak")
    isovalue: float = Field(0.1, gt=0, lt=1, description="t")
    theta_deg: float = Field(58.0, ge=0, lt=90, description="slant, deg")
    smoothing_px: float = Field(
        PAPER_SMOOTHING_PX, ge=0, le=50, description="standard deviation of the Gaussian smoothing, px"
    )
    recentre: bool = Field(True, description="centre the texture's window at the BP; false: at the camera's foot")

    @model_validator(mode="after")
    def _light_in_front(self) -> "PaperSetting":
        # Lights lie at V + eps (cos a, sin a, b) with b down to -1/2.
        if self.eps >= 2 * self.height:
            raise ValueError(
                f"eps = {self.eps:g} and height = {self.height:g}: the lowest light, at height - eps / 2, would lie "
                "behind the plane; eps must be less than 2 height"
            )
        return self

    @property
    def camera(self) -> Camera:
        """The imaging camera: f = M, c = M/2."""
        size = self.size
        return Camera(size, size, float(size), float(size), size / 2, size / 2)

    @property
    def normal(self) -> Array:
        """The plane's normal in the imaging camera's frame, facing it, unit, shape (3,)."""
        theta = np.radians(self.theta_deg)
        return np.array([0.0, np.sin(theta), -np.cos(theta)])


class PaperScene(Spec):
    """A scene of the published protocol."""

    name: str = Field("published", min_length=1, max_length=80)
    paper: PaperSetting = PaperSetting()


def is_paper(data: Mapping[str, Any]) -> bool:
    """Return whether a scene's tables are those of the published protocol."""
    return "paper" in data


def paper_from_dict(data: Mapping[str, Any], where: str) -> PaperSetting:
    """Validate a scene of the published protocol given as nested tables; raise `InputError` if it is malformed."""
    return validate(PaperScene, data, where).paper


LawName = Literal[
    "circle_pose", "branch_point", "axis_ratio", "axis_ratio_seen", "offset", "bisector", "falloff", "look"
]
"""Error laws of docs/concepts/theory.md, section 4, that a page compares with measured errors."""


def _check_order(low: float, high: float) -> None:
    """Raise `ValueError` where the ends of a range are not in order."""
    if low > high:
        raise ValueError(f"low = {low:.10g} must not exceed high = {high:.10g}")


class Uniform(Spec):
    """A uniform distribution over [low, high)."""

    low: float
    high: float

    @model_validator(mode="after")
    def _ordered(self) -> "Uniform":
        _check_order(self.low, self.high)
        return self


Tables = tuple[dict[str, tuple[Any, ...]], ...]
"""Of equally long lists by key path, which vary together."""


class Group(Spec):
    """One family of settings on one base scene.

    `sweep` holds tables of equally long lists that vary together; several tables are multiplied out. `pool` is the
    same, but its values count as realisations of one setting. `random` draws a value for each realisation.
    """

    scene: str = Field(description="base scene: a shipped name or a path")
    label: str = Field("", max_length=80, description="name of the curve in the figures; default the surface's")
    set: dict[str, Any] = Field(default_factory=dict, description="values that replace the scene's, by key path")
    sweep: Tables = ()
    pool: Tables = ()
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


class CoreRegions(Spec):
    """Calibrations of cores (`simtest calibrate core`), whose answers then have regions of 68 and 95 %."""

    files: tuple[str, ...] = Field(min_length=1)
    refuse_above_deg: float | None = Field(None, gt=0, le=180, description="answers with a larger one are refused")
    shifted: Literal["widen", "refuse"] = Field("widen", description="answers in frames unlike the calibration's")


class Experiment(Spec):
    """A validation experiment.

    Examples
    --------
    >>> import simtest
    >>> experiment = simtest.load_experiment("overview")
    >>> experiment.name, "cone_axis" in experiment.estimators
    ('overview', True)
    """

    name: Name = Field(description="seeds depend on it; default the name of the file")
    title: str = ""
    description: str = ""
    realisations: int = Field(20, ge=1, le=10**6)
    seed: int = Field(0, ge=0, lt=2**63)
    estimators: tuple[str, ...] = Field(("circle_pose", "brightest_point", "cone_axis"), min_length=1)
    groups: tuple[Group, ...] = Field(min_length=1)
    regions: CoreRegions | None = Field(None, description="calibrations of its cores; default none", **UNSAID)

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
    settings = as_settings(settings)
    own = {key: settings.pop(key) for key in list(settings) if key in OWN_KEYS}
    viewpoints = own.pop("viewpoints", None)
    changes = [f"{key}={value}" for key, value in settings.items()]
    check_first_parts(settings, [*Scene.model_fields, *PaperScene.model_fields], OWN_KEYS)
    experiment = load(Experiment, path, own)
    groups = tuple(_override(group, settings) for group in experiment.groups)
    if viewpoints is not None:
        groups = tuple(_with_first_viewpoints(group, viewpoints) for group in groups)
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


def still_varied(varied: Iterable[str], settings: Mapping[str, Any], what: str) -> list[str]:
    """Return which of the key paths that an experiment or a dataset varies stay so beside settings.

    A setting fixes its path, all below it and the keys that it excludes.
    """
    left = dict.fromkeys(varied)
    for path in settings:
        if whole := next((key for key in left if path.startswith(f"{key}.")), None):
            raise InputError(f"--set {path}: the {what} varies {whole} as a whole; set {whole} itself instead")
    return [key for key in left if not _is_replaced(key, settings)]


def replaced(values: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by key path, with settings in place of those that they fix."""
    return {**{key: value for key, value in values.items() if not _is_replaced(key, settings)}, **settings}


def _is_replaced(key: str, settings: Mapping[str, Any]) -> bool:
    """Return whether a key path is one that settings fix: theirs, one below it, or one that it excludes."""
    fixed = (each for path in settings for each in (path, *rivals(path)))
    return any(f"{key}.".startswith(f"{path}.") for path in fixed)


def _with_first_viewpoints(group: Group, count: object) -> Group:
    """Keep the first viewpoints of a group that varies them."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"--set viewpoints={count!s}: must be a whole number from 1 on")

    return group.model_copy(
        update={"sweep": _first(group.sweep, count, VIEWPOINT), "pool": _first(group.pool, count, VIEWPOINT)}
    )


def _first(tables: Tables, count: int, key: str = "") -> Tables:
    """Keep the first values of tables, or of those that vary a key: each value's seed depends on its index."""
    return tuple(
        {name: values[:count] for name, values in table.items()} if not key or key in table else table
        for table in tables
    )


def _override(group: Group, settings: Mapping[str, Any]) -> Group:
    """Fix scene values in a group; swept and random values of the same path, or below it, are dropped."""
    varied = [*group.random, *(key for table in (*group.sweep, *group.pool) for key in table)]
    kept = still_varied(varied, settings, "experiment")

    def without(tables: Tables) -> Tables:
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


MAX_SAMPLES = 100_000_000


class Distribution(Spec):
    """What a value is drawn from: a range with `low` and `high`, or a list to `choose` from."""

    low: float | None = Field(None, description="least value")
    high: float | None = Field(None, description="values lie below it; of integers it is the largest")
    log: bool = Field(False, description="even in the logarithm")
    integer: bool = Field(False, description="whole numbers, high included")
    choose: tuple[Any, ...] = Field((), description="the values themselves")
    weights: tuple[float, ...] = Field((), description="how often each of them, relative to the others; default alike")

    @model_validator(mode="after")
    def _one_way(self) -> "Distribution":
        if not self.choose:
            self._check_range()
        elif self.low is not None or self.high is not None or self.log or self.integer:
            raise ValueError("choose excludes low, high, log and integer; give a range or a list")
        if self.weights and len(self.weights) != len(self.choose):
            raise ValueError(f"weights has {len(self.weights)} values and choose {len(self.choose)}; must be as many")
        if self.weights and (min(self.weights) < 0 or sum(self.weights) <= 0):
            raise ValueError("weights must be 0 or more, and not all 0")
        return self

    def _check_range(self) -> None:
        if self.low is None or self.high is None:
            raise ValueError("nothing to draw from; must have low and high, or choose = [...]")
        _check_order(self.low, self.high)
        if self.log and self.low <= 0:
            raise ValueError(f"low = {self.low:g}: must be above 0 where log is true")
        if self.integer and (self.low % 1 or self.high % 1):
            raise ValueError(f"low = {self.low:g}, high = {self.high:g}: must be whole where integer is true")

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw a value."""
        if self.choose:
            shares = np.asarray(self.weights or [1.0] * len(self.choose))
            return self.choose[int(rng.choice(len(self.choose), p=shares / shares.sum()))]
        assert self.low is not None
        assert self.high is not None
        if self.integer and self.log:
            # the whole part of what lies below the next number
            return min(int(math.exp(rng.uniform(math.log(self.low), math.log(self.high + 1)))), int(self.high))
        if self.integer:
            # high counts, unlike in a continuous range
            return int(rng.integers(int(self.low), int(self.high), endpoint=True))
        if self.log:
            return float(math.exp(rng.uniform(math.log(self.low), math.log(self.high))))
        return float(rng.uniform(self.low, self.high))

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values at which a scene must be sound: both ends of a range, or the whole list."""
        if self.choose:
            return self.choose
        assert self.low is not None
        assert self.high is not None
        return (int(self.low), int(self.high)) if self.integer else (self.low, self.high)


class Splits(Spec):
    """Shares of the samples; no anatomy is in two of them. Where some are named the others are 0."""

    train: Share = 0.8
    validation: Share = 0.1
    test: Share = 0.1

    @model_validator(mode="before")
    @classmethod
    def _unnamed(cls, given: object) -> object:
        return {**dict.fromkeys(cls.model_fields, 0.0), **given} if isinstance(given, dict) and given else given

    @model_validator(mode="after")
    def _whole(self) -> "Splits":
        total = self.train + self.validation + self.test
        # Shares are written in decimals, whose sum is rounded.
        if abs(total - 1) > 1e-6:
            raise ValueError(f"train + validation + test = {total:g}: must be 1")
        return self

    @property
    def shares(self) -> dict[str, float]:
        """Share by name, those of 0 left out."""
        return {name: share for name, share in self.model_dump().items() if share > 0}


class SeedRange(Spec):
    """Whole numbers from low to high, both included."""

    low: int = Field(0, ge=0, lt=2**32)
    high: int = Field(ge=0, lt=2**32)

    @model_validator(mode="after")
    def _ordered(self) -> "SeedRange":
        _check_order(self.low, self.high)
        return self

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return self.high - self.low + 1


class Family(Spec):
    """Anatomies of one kind: a base scene, and what tells one anatomy from the next."""

    scene: str = Field(description="base scene: a shipped name or a path")
    weight: float = Field(1.0, gt=0, le=1e6, description="share of the anatomies, relative to the other families'")
    set: dict[str, Any] = Field(default_factory=dict, description="values that replace the scene's, by key path")
    seeds: SeedRange | None = Field(
        None, description="range of surface.seed, each used once; default: one anatomy, that of the scene"
    )
    per_anatomy: dict[str, Distribution] = Field(default_factory=dict, description="drawn once for each anatomy")
    per_sample: dict[str, Distribution] = Field(default_factory=dict, description="drawn anew for each sample")

    @model_validator(mode="after")
    def _told_apart(self) -> "Family":
        if self.per_anatomy and self.seeds is None:
            raise ValueError("per_anatomy needs seeds, which tell the anatomies apart")
        return self


class Dataset(Spec):
    """A labelled dataset."""

    name: Name = Field(description="default the name of the file")
    title: str = ""
    description: str = ""
    samples: int = Field(1000, ge=1, le=MAX_SAMPLES)
    seed: int = Field(0, ge=0, lt=2**63)
    samples_per_anatomy: int = Field(20, ge=1, le=10**6)
    splits: Splits = Splits()
    families: tuple[Family, ...] = Field(min_length=1, max_length=100)
    per_sample: dict[str, Distribution] = Field(
        default_factory=dict, description="drawn anew for each sample of every family"
    )
    highlights: int = Field(
        1, ge=0, le=100, description="isolated highlights that a frame shows at least; 0 takes every frame"
    )
    tries: int = Field(8, ge=1, le=1000, description="draws for such a frame; the last is taken as it is")
    estimators: tuple[str, ...] = Field(
        ("circle_pose", "brightest_point", "cone_axis"), description="classical estimates kept beside the truth"
    )
    radiance: bool = Field(False, description="keep the linear radiance as well (float16)")
    visible: bool = Field(False, description="keep the pixels of the visible highlights as well, and list these")
    exact: bool = Field(
        False,
        description="normals and curvatures of the smooth surface at each pixel, some seconds a sample; "
        "false: interpolated between the triangles' corners. Those of highlights are exact always",
    )
    shard_mb: float = Field(256.0, gt=0, le=4096, description="size of a shard, MB, about")

    @model_validator(mode="after")
    def _enough_anatomies(self) -> "Dataset":
        for family in self.families:
            twice = sorted(set(family.per_sample) & set(self.per_sample))
            if twice:
                raise ValueError(f"{twice[0]}: drawn twice; a key may be in one per_sample only")
        return self


_DATASET_KEYS = frozenset(Dataset.model_fields) - {"families", "per_sample", "name"}


@plain_errors
def load_dataset(name: str | Path, settings: Mapping[str, Any] | None = None) -> Dataset:
    """Read a dataset file.

    Parameters
    ----------
    name : str or Path
        A path, or the name of a shipped dataset.
    settings : mapping, optional
        Values by key path. The dataset's own keys (samples, seed, ...) are replaced; all other paths are those of the
        scene and apply to every family, in place of a distribution.

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    path = find(name, "scenes", "datasets")
    # The dataset's own keys; all others are keys of the scenes.
    settings = as_settings(settings)
    own = {key: settings.pop(key) for key in list(settings) if key.split(".")[0] in _DATASET_KEYS}
    check_first_parts(settings, Scene.model_fields, _DATASET_KEYS)
    dataset = load(Dataset, path, own)
    if not settings:
        return dataset

    # A value that is set is no longer drawn.
    def left(drawn: dict[str, Distribution]) -> dict[str, Distribution]:
        return {key: drawn[key] for key in still_varied(drawn, settings, "dataset")}

    families = tuple(
        family.model_copy(
            update={
                "set": replaced(family.set, settings),
                "per_anatomy": left(family.per_anatomy),
                "per_sample": left(family.per_sample),
            }
        )
        for family in dataset.families
    )
    return dataset.model_copy(update={"families": families, "per_sample": left(dataset.per_sample)})


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
        groups = tuple(group.model_copy(update={"pool": _first(group.pool, entry.pool)}) for group in groups)
    return experiment.model_copy(update={"groups": groups, "name": entry.name or experiment.name})


def scene_models(experiment: Experiment) -> list[BaseModel]:
    """Return the base scenes of an experiment's groups, with the values that each group sets."""
    found: list[BaseModel] = []
    for group in experiment.groups:
        path = find(group.scene, "scenes")
        data = replace_values(Scene, read_toml(path), group.set, str(path))
        found.append(validate(PaperScene if is_paper(data) else Scene, data, str(path)))
    return found
