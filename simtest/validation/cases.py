"""From an experiment to its cases: one scene each, in a fixed order, with a name that seeds hang on."""

import itertools
import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from simtest.errors import InputError
from simtest.runtime.resources import find, shown
from simtest.runtime.seeds import Stage, generator, integer
from simtest.spec import AnatomySurface, Experiment, Group, Scene, apply_settings, read_toml, scene_from_dict
from simtest.spec.paper import PaperSetting, is_paper, paper_from_dict
from simtest.spec.toml_files import toml_value
from simtest.surfaces.recipe import load_recipe


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
    swept : dict
        Value by key path of the swept and pooled parameters.
    data : dict
        The scene's tables.
    where : str
        The scene's file, for messages.
    random : dict
        Distribution by key path, drawn for each realisation.
    realisations : int
        How many.
    isolated : bool
        Whether isolated highlights alone count as true ones.
    source : str
        Name or path of the base scene, as the experiment gives it.
    settings : dict
        Value by key path of all that differs from the base scene, drawn values apart.
    laws : tuple of str
        Names of the laws that the page holds against the setting.
    """

    label: str
    setting: str
    part: int
    swept: dict[str, Any]
    data: dict[str, Any]
    where: str
    random: dict[str, Any]
    realisations: int
    isolated: bool
    source: str
    settings: dict[str, Any]
    laws: tuple[str, ...] = ()

    @property
    def is_paper(self) -> bool:
        """Whether the case is one of the published protocol, which renders nothing."""
        return is_paper(self.data)

    def paper_setting(self) -> PaperSetting:
        """Give the setting of the published protocol; raises `InputError` where a value does not fit."""
        return paper_from_dict(self.data, self.where)

    def paper_columns(self) -> dict[str, Any]:
        """Give every parameter of the published protocol by key path, swept or not, for the rows' columns."""
        return {f"paper.{name}": value for name, value in self.paper_setting().model_dump().items()}

    @property
    def name(self) -> str:
        """The case's place in the seed tree."""
        return f"{self.setting} | part {self.part}"

    def numbers(self) -> range:
        """Numbers of the realisations, running on over the parts of a setting."""
        return range(self.part * self.realisations, (self.part + 1) * self.realisations)

    def scene(self, experiment: Experiment, realisation: int) -> tuple[Scene, dict[str, Any]]:
        """Give the scene of a realisation and the values drawn for it.

        Raises
        ------
        InputError
            If a swept or drawn value does not fit the schema.
        """
        rng = generator(experiment.seed, experiment.name, self.name, realisation, Stage.SWEEP)
        drawn = {path: float(rng.uniform(d.low, d.high)) for path, d in self.random.items()}
        data = apply_settings(self.data, drawn, self.where) if drawn else self.data
        scene = scene_from_dict(data, self.where)
        if scene.render.samples_per_pixel > 1 or scene.render.path_depth > 2:
            seed = integer(experiment.seed, experiment.name, self.name, realisation if drawn else 0, Stage.RENDER)
            scene = scene.model_copy(update={"render": scene.render.model_copy(update={"seed": seed % 2**32})})
        if scene.rig.is_drawn:
            seed = integer(experiment.seed, experiment.name, self.name, realisation, Stage.RIG)
            scene = scene.model_copy(update={"rig": scene.rig.model_copy(update={"seed": seed})})
        return scene, drawn

    def noise_seed(self, experiment: Experiment, realisation: int) -> int:
        """Give the seed of a realisation's noise: the `seed` column, and ``sensor.seed`` of a scene made alone."""
        return integer(experiment.seed, experiment.name, self.name, realisation, Stage.SENSOR)

    def again(self, experiment: Experiment, realisation: int) -> str:
        """Give the command that makes a realisation's frame again alone, less its --out."""
        scene, drawn = self.scene(experiment, realisation)
        values = {**self.settings, **drawn, "sensor.seed": self.noise_seed(experiment, realisation)}
        if scene.render.seed != self.data.get("render", {}).get("seed", 0):
            values["render.seed"] = scene.render.seed
        if scene.rig.is_drawn:
            values["rig.seed"] = scene.rig.seed
        return f"simtest render {shlex.quote(self.source)} {set_options(values)}"


def expand(experiment: Experiment) -> list[Case]:
    """List an experiment's cases.

    Parameters
    ----------
    experiment : Experiment
        From a file.

    Returns
    -------
    list of Case
        In the order of the file.

    Raises
    ------
    InputError
        If a scene is missing or malformed, a swept value or an end of a drawn range does not fit, or two settings
        share a name: found before anything is rendered.
    """
    cases = [case for group in experiment.groups for case in _expand_group(experiment, group)]
    names: set[str] = set()
    for case in cases:
        if case.name in names:
            raise InputError(
                f"experiment {experiment.name}: two settings are called {shown(case.setting)!r}; "
                "give the groups different labels, and each value of a sweep once"
            )
        names.add(case.name)
        _check(case, experiment)
    return cases


def _check(case: Case, experiment: Experiment) -> None:
    """Raise `InputError` where a scene of a case would be malformed; a drawn range is tried at both ends."""
    if case.is_paper:
        case.paper_setting()
        if case.random:
            raise InputError(f"{case.where}: random: the published protocol draws its light itself; use sweep or pool")
        return
    first, _ = case.scene(experiment, case.numbers()[0])
    lows = {path: float(d.low) for path, d in case.random.items()}
    # The upper end itself is never drawn.
    highs = {path: max(math.nextafter(d.high, -math.inf), d.low) for path, d in case.random.items()}
    ends = [{path: value} for tried in (lows, highs) for path, value in tried.items()]
    for values in ends if len(lows) < 2 else (*ends, lows, highs):
        scene_from_dict(apply_settings(case.data, values, case.where), case.where)
    if isinstance(first.surface, AnatomySurface) and (file := first.surface.file()).suffix == ".toml":
        load_recipe(file, first.surface.recipe_values)


def _expand_group(experiment: Experiment, group: Group) -> list[Case]:
    path = find(group.scene, "scenes")
    base = apply_settings(read_toml(path), group.set, str(path))
    base.setdefault("name", path.stem)
    count = experiment.realisations if group.realisations is None else group.realisations
    cases = []
    for swept in _combinations(group.sweep):
        for part, pooled in enumerate(_combinations(group.pool)):
            values = {**swept, **pooled}
            data = apply_settings(base, values, str(path))
            label = group.label or ("published" if is_paper(data) else scene_from_dict(data, str(path)).surface.label)
            setting = ", ".join([label, *(f"{_short(key, swept)}={_plain(value)}" for key, value in swept.items())])
            columns = {key: _plain(value) for key, value in values.items()}
            settings = {**group.set, **values}
            random, source = dict(group.random), group.scene
            cases.append(
                Case(
                    label, setting, part, columns, data, str(path), random, count, group.isolated, source, settings,
                    group.laws,
                )
            )  # fmt: skip
    return cases


def _combinations(tables: tuple[Mapping[str, tuple[Any, ...]], ...]) -> list[dict[str, Any]]:
    """Multiply tables out; within one table the lists vary together."""
    rows = [[dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)] for table in tables]
    return [{k: v for part in parts for k, v in part.items()} for parts in itertools.product(*rows)]


def _short(path: str, among: Mapping[str, Any]) -> str:
    """Give the last part of a key path, or all of it where that is not unique."""
    last = path.rsplit(".", 1)[-1]
    return last if sum(key.rsplit(".", 1)[-1] == last for key in among) == 1 else path


def set_options(values: Mapping[str, Any]) -> str:
    """Write values by key path as command-line options that read back the same."""
    return " ".join(f"--set {shlex.quote(f'{key}={_toml(value)}')}" for key, value in values.items())


def _plain(value: Any) -> Any:
    """Give a swept value as it stands in a column: numbers and text as they are, a table by its type."""
    if isinstance(value, Mapping):
        return str(value.get("type", _toml(value)))
    return _toml(value) if isinstance(value, list | tuple) else value


def _toml(value: Any) -> str:
    """Write a value so that ``--set key=value`` reads it back: text stays bare."""
    return value if isinstance(value, str) else toml_value(value)


def swept_example(cases: list[Case]) -> dict[str, Any]:
    """Give an example value for each swept, pooled or drawn parameter: the columns that results gain."""
    example: dict[str, Any] = {}
    for case in cases:
        example |= case.swept
        example |= dict.fromkeys(case.random, 0.0)
        if case.is_paper:
            example |= {key: value for key, value in case.paper_columns().items() if key not in example}
            example["bound_deg"] = 0.0
    return example
