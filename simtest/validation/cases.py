"""Expands an experiment into cases: one scene each, in a fixed order, under the name that its seeds depend on."""

import itertools
import json
import math
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from simtest.conventions import MOTION_COLUMNS, ON_INSTRUMENT
from simtest.errors import InputError
from simtest.runtime.files import Json
from simtest.runtime.resources import find
from simtest.runtime.seeds import Stage, generator, integer
from simtest.spec import AnatomySurface, Experiment, Group, Scene, Uniform, apply_settings, read_toml, scene_from_dict
from simtest.spec.keys import replace_values
from simtest.spec.recipes import CoreRegions, PaperSetting, is_paper, paper_from_dict
from simtest.spec.toml_files import toml_value
from simtest.surfaces.recipe import load_recipe

if TYPE_CHECKING:
    from simtest.validation.columns import Value

RELIEF_SEED = "surface.relief.seed"

MOST = {"values": 20_000, "settings": 10_000, "realisations": 10_000_000}
"""Of one list of a sweep or pool; of an experiment, pooled settings counted singly; of one, over all settings."""

Tables = dict[str, Any]
"""A scene's tables, as read from TOML."""


@dataclass(frozen=True)
class Case:
    """One setting of an experiment, or one pooled part of it.

    Parameters
    ----------
    label : str
        Name of the curve.
    setting : str
        Name of the setting within the experiment, unique together with the part.
    part : int
        Which of the setting's pooled values.
    swept : mapping
        Swept and pooled parameters by key path, as they stand in a column.
    data : dict
        The scene's tables.
    where : str
        The scene's file, for messages.
    random : mapping
        Distributions by key path, drawn for each realisation.
    realisations : int
        How many.
    isolated : bool
        Whether isolated highlights alone count as true ones.
    source : str
        Name or path of the base scene, as the experiment gives it.
    settings : mapping
        Values by key path of all that differs from the base scene, except drawn ones.
    laws : tuple of str
        Names of the laws that the page compares with the setting's results.
    """

    label: str
    setting: str
    part: int
    swept: "Mapping[str, Value]"
    data: Tables
    where: str
    random: Mapping[str, Uniform]
    realisations: int
    isolated: bool
    source: str
    settings: Mapping[str, Json]
    laws: tuple[str, ...] = ()

    @property
    def is_paper(self) -> bool:
        """Whether the case is one of the published protocol, which renders nothing."""
        return is_paper(self.data)

    @property
    def is_coloured(self) -> bool:
        """Whether its scenes take three channels, as one at the lower or upper ends of what is drawn does."""
        if self.is_paper:
            return False
        scenes = (scene_from_dict(apply_settings(self.data, values, self.where), self.where) for values in self.ends)
        return any(scene.is_coloured for scene in scenes)

    @property
    def ends(self) -> tuple[dict[str, float], dict[str, float]]:
        """The lower and the upper ends of what is drawn, by key path; an upper end itself is never drawn."""
        lows = {path: float(d.low) for path, d in self.random.items()}
        return lows, {path: max(math.nextafter(d.high, -math.inf), d.low) for path, d in self.random.items()}

    def paper_setting(self) -> PaperSetting:
        """Return the setting of the published protocol; raise `InputError` where a value does not fit."""
        return paper_from_dict(self.data, self.where)

    def paper_columns(self) -> "dict[str, Value]":
        """Return every parameter of the published protocol by key path, swept or not: columns of the rows."""
        return {f"paper.{name}": value for name, value in self.paper_setting().model_dump().items()}

    @property
    def name(self) -> str:
        """Name of the case in the seed tree."""
        return f"{self.setting} | part {self.part}"

    def numbers(self) -> range:
        """Numbers of the realisations, running on over the parts of a setting."""
        return range(self.part * self.realisations, (self.part + 1) * self.realisations)

    def scene(self, experiment: Experiment, realisation: int) -> tuple[Scene, dict[str, float]]:
        """Make the scene of a realisation; return it with the values drawn for it, by key path."""
        # Drawn values.
        rng = generator(experiment.seed, experiment.name, self.name, realisation, Stage.SWEEP)
        drawn = {path: float(rng.uniform(d.low, d.high)) for path, d in self.random.items()}
        data = apply_settings(self.data, drawn, self.where) if drawn else self.data
        scene = scene_from_dict(data, self.where)
        # Seeds of what else is random: the renderer's samples, which realisations of one scene share, ...
        if scene.render.samples_per_pixel > 1 or scene.render.path_depth > 2:
            seed = integer(experiment.seed, experiment.name, self.name, realisation if drawn else 0, Stage.RENDER)
            scene = scene.model_copy(update={"render": scene.render.model_copy(update={"seed": seed % 2**32})})
        # ... and the rig's deviations and the relief, which they do not.
        if scene.rig.is_drawn:
            seed = integer(experiment.seed, experiment.name, self.name, realisation, Stage.RIG)
            scene = scene.model_copy(update={"rig": scene.rig.model_copy(update={"seed": seed})})
        if scene.surface.relief is not None and not self._relief_is_given:
            seed = integer(experiment.seed, experiment.name, self.name, realisation, Stage.RELIEF) % 2**32
            relief = scene.surface.relief.model_copy(update={"seed": seed})
            scene = scene.model_copy(update={"surface": scene.surface.model_copy(update={"relief": relief})})
        return scene, drawn

    @property
    def _relief_is_given(self) -> bool:
        """Whether the experiment itself names the relief's seed, so that none is drawn."""
        return RELIEF_SEED in self.settings or RELIEF_SEED in self.random

    @property
    def has_own_relief(self) -> bool:
        """Whether the case sweeps or pools the relief's seed, so that its relief is that of few frames."""
        return RELIEF_SEED in self.swept

    def noise_seed(self, experiment: Experiment, realisation: int) -> int:
        """Return the seed of a realisation's noise: the `seed` column, and ``sensor.seed`` of a scene made alone."""
        return integer(experiment.seed, experiment.name, self.name, realisation, Stage.SENSOR)

    def reproduce_command(self, experiment: Experiment, realisation: int) -> str:
        """Return the command that renders a realisation's frame alone."""
        scene, drawn = self.scene(experiment, realisation)
        noise = self.noise_seed(experiment, realisation)
        values: dict[str, Json] = {**self.settings, **drawn, "sensor.seed": noise}
        # Seeds that `scene` has drawn.
        if scene.render.seed != self.data.get("render", {}).get("seed", 0):
            values["render.seed"] = scene.render.seed
        if scene.rig.is_drawn:
            values["rig.seed"] = scene.rig.seed
        if scene.surface.relief is not None and not self._relief_is_given:
            values[RELIEF_SEED] = scene.surface.relief.seed
        return f"simtest render {shlex.quote(self.source)} {_set_options(values)} --out frame"


def expand(experiment: Experiment) -> list[Case]:
    """Return an experiment's cases, in the order of its groups."""
    check_effort(experiment)
    cases = [case for group in experiment.groups for case in _expand_group(experiment, group)]
    names: set[str] = set()
    recipes: set[str] = set()
    for case in cases:
        if case.name in names:
            raise InputError(
                f"experiment {experiment.name}: two settings are called {case.setting!r}; "
                "give the groups different labels, and each value of a sweep once"
            )
        names.add(case.name)
        _check(case, experiment, recipes)
    return cases


def check_effort(experiment: Experiment) -> None:
    """Raise `InputError` where an experiment has more settings or realisations than are allowed."""
    settings = realisations = 0
    for number, group in enumerate(experiment.groups):
        where = f"experiment {experiment.name}: groups.{number}"
        count = 1
        for kind, tables in (("sweep", group.sweep), ("pool", group.pool)):
            for table in tables:
                key, values = next(iter(table.items()))
                _check_most(len(values), "values", f"{where}.{kind}: {key}")
                count *= len(values)
        settings += count
        realisations += count * (experiment.realisations if group.realisations is None else group.realisations)
        _check_most(settings, "settings", where, ", up to this group")
        _check_most(realisations, "realisations", where, ", up to this group")


def _check_most(value: int, what: str, where: str, counted: str = "") -> None:
    if value > MOST[what]:
        raise InputError(f"{where}: {value} {what}{counted}; at most {MOST[what]} are allowed")


def _check(case: Case, experiment: Experiment, recipes: set[str]) -> None:
    """Raise `InputError` if a scene of a case is malformed; drawn ranges are tried at both ends.

    A recipe whose file and values are among `recipes` has been read before; one that is read is added.
    """
    # Published protocol: nothing is rendered.
    if case.is_paper:
        case.paper_setting()
        if case.random:
            raise InputError(f"{case.where}: random: the published protocol draws its light itself; use sweep or pool")
        return
    first, _ = case.scene(experiment, case.numbers()[0])
    lows, highs = case.ends
    # Each range alone and, where there are several, all together.
    ends = [{path: value} for tried in (lows, highs) for path, value in tried.items()]
    for values in ends if len(lows) < 2 else (*ends, lows, highs):
        scene_from_dict(apply_settings(case.data, values, case.where), case.where)
    # An anatomy's recipe is read only when its mesh is made: check it here.
    if isinstance(first.surface, AnatomySurface) and (file := first.surface.file()).suffix == ".toml":
        described = json.dumps([str(file), first.surface.recipe_values], sort_keys=True, default=repr)
        if described not in recipes:
            load_recipe(file, first.surface.recipe_values)
            recipes.add(described)


def _expand_group(experiment: Experiment, group: Group) -> list[Case]:
    path = find(group.scene, "scenes")
    base = replace_values(Scene, read_toml(path), group.set, str(path))
    base.setdefault("name", path.stem)
    count = experiment.realisations if group.realisations is None else group.realisations
    cases = []
    for swept in _combinations(group.sweep):
        for part, pooled in enumerate(_combinations(group.pool)):
            # Scene.
            values = {**swept, **pooled}
            data = replace_values(Scene, base, values, str(path))
            # Names: pooled values are parts of one setting, so they are not in its name.
            label = group.label or ("published" if is_paper(data) else scene_from_dict(data, str(path)).surface.label)
            setting = ", ".join([label, *(f"{_short(key, swept)}={_plain(value)}" for key, value in swept.items())])
            columns = {key: _plain(value) for key, value in values.items()}
            settings = {**group.set, **values}
            case = Case(
                label, setting, part, columns, data, str(path), group.random, count, group.isolated, group.scene,
                settings, group.laws,
            )  # fmt: skip
            cases.append(case)
    return cases


def _combinations(tables: tuple[Mapping[str, tuple[Json, ...]], ...]) -> list[dict[str, Json]]:
    """Return all combinations of the tables' rows; within one table the lists vary together."""
    rows = [[dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)] for table in tables]
    return [{k: v for part in parts for k, v in part.items()} for parts in itertools.product(*rows)]


def _short(path: str, among: Iterable[str]) -> str:
    """Return the last part of a key path, an index with its list, or all of it where that is not unique."""
    last = _last(path)
    return last if sum(_last(key) == last for key in among) == 1 else path


def _last(path: str) -> str:
    parts = path.split(".")
    return ".".join(parts[-2:] if parts[-1].isdecimal() else parts[-1:])


def _set_options(values: Mapping[str, Json]) -> str:
    """Write values by key path as command-line options that read back the same."""
    return " ".join(f"--set {shlex.quote(f'{key}={_toml(value)}')}" for key, value in values.items())


def _plain(value: Json) -> "Value":
    """Return a swept value as it stands in a column: numbers and text as they are, a table by its type."""
    if isinstance(value, dict):
        return str(value.get("type", _toml(value)))
    return value if value is None or isinstance(value, bool | int | float | str) else _toml(value)


def _toml(value: Json) -> str:
    """Write a value so that ``--set key=value`` reads it back: text stays bare."""
    return value if isinstance(value, str) else toml_value(value)


def swept_example(cases: list[Case], regions: CoreRegions | None = None) -> "dict[str, Value]":
    """Return an example value for each swept, pooled or drawn parameter: the columns that results gain."""
    example: dict[str, Value] = {}
    if regions is not None:
        # Imported here: a finished run is recognised without what made it.
        from simtest.estimators.protocol import CalibratedRegion

        example |= asdict(CalibratedRegion(0.0, 0.0, ""))
    for case in cases:
        example |= case.swept
        example |= dict.fromkeys(case.random, 0.0)
        if case.is_paper:
            example |= {key: value for key, value in case.paper_columns().items() if key not in example}
            example["bound_deg"] = 0.0
        if case.data.get("instruments"):
            example[ON_INSTRUMENT] = False
        if case.data.get("views") is not None:
            example |= dict.fromkeys(MOTION_COLUMNS, 0.0)
    return example
