"""Draw the nights and counts the gate's verdicts on them."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from simtest.errors import SimtestError
from simtest.nightly.contrasts import margin_of
from simtest.nightly.quantities import QUANTITIES
from simtest.runtime.processes import make_engine
from simtest.spec import Experiment
from simtest.validation.runner import run_experiment
from studies.gate.bank import COLUMNS, experiment
from studies.gate.faults import FAULTS, HARMLESS, Mutation, planted
from studies.gate.nights import Draw, Found, Fresh, Paired, Source, equal_cells, judge_many, raised
from tests.laws.all_laws import measures
from tests.laws.law import Law

FRESH_NIGHTS = int(os.environ.get("GATE_NIGHTS") or 1000)
"""Nights of fresh seeds of each kind; GATE_NIGHTS changes it."""

PAIRED_NIGHTS, DETECTION_NIGHTS = 200, 100
N = 10
"""Realisations of each setting in a night."""

RISE = 0.10

HARMLESS_CONTENT = {"paper": 10, "curvature": 4, "light_offset": 4, "compare": 4, "anatomy": 2}
"""Realisations of each setting that are made again with harmless changes; of a night's: `HARMLESS_N`."""

HARMLESS_N = 3
TWO_PROCESSES = "two processes of half the threads"


@dataclass(frozen=True)
class Rate:
    """How often the gate raised the alarm.

    `name`: of what was changed; `nights`: how many were judged; `alarms`: how many of them were called a
    regression, or changed; `about`: what else is known.
    """

    name: str
    nights: int
    alarms: int
    about: str = ""

    @property
    def share(self) -> float:
        """Alarms over nights."""
        return self.alarms / self.nights


@dataclass(frozen=True)
class Caught:
    """What saw a planted fault.

    `name`: of the fault; `laws`: those that do not hold; `paired`, `fresh`: of nights of the same seeds, and of
    others; `stops`: whether the night could not be run: exit 2, which is seen as well.
    """

    name: str
    laws: tuple[str, ...]
    paired: Rate
    fresh: Rate
    stops: bool


def bank_folder() -> Path:
    """Return the bank's folder."""
    return Path(os.environ.get("GATE_BANK") or Path(tempfile.gettempdir()) / "gate-bank")


def _rate(name: str, draw: Draw, nights: int, first_seed: int = 0, about: str = "") -> Rate:
    found = judge_many(draw, range(first_seed, first_seed + nights))
    return Rate(name, nights, sum(night.alarm for night in found), about or _family(found))


def _family(found: list[Found]) -> str:
    tests = [night.tests for night in found]
    least = min(night.least for night in found)
    return f"{min(tests)} to {max(tests)} tests a night, least corrected p-value {least:.2g}"


def false_alarms(bank: pl.DataFrame, nights: int = FRESH_NIGHTS) -> list[Rate]:
    """Judge nights of fresh seeds against others, where nothing has changed."""
    source = Source.of(bank)
    counts = {N: f"{N} fresh realisations a setting", 2: "2 fresh realisations a setting", 1: "1 fresh realisation"}
    return [_rate(name, Fresh(source, n), nights) for n, name in counts.items()]


def harmless(nights: int = PAIRED_NIGHTS) -> list[Rate]:
    """Judge nights whose code rounds in another way against nights of the same seeds."""
    before = _again(HARMLESS_CONTENT)
    made = []
    for name, mutations in {TWO_PROCESSES: (), **HARMLESS}.items():
        after = _again(HARMLESS_CONTENT, mutations, workers=2 if name == TWO_PROCESSES else 1)
        equal = equal_cells(before, after) if before.height == after.height else None
        draw = Paired(Source.of(before), Source.of(after), HARMLESS_N, equal)
        cells = after.select("experiment", "setting", "estimator").n_unique()
        same = 0 if equal is None else equal.height
        about = f"{same} of {cells} cells bit-equal; {_apart(before, after)}"
        made.append(_rate(name, draw, nights, about=about))
    return made


def _apart(before: pl.DataFrame, after: pl.DataFrame) -> str:
    """Report how far the errors of the same highlights are apart."""
    keys = ("experiment", "setting", "realisation", "estimator", "true_id")
    both = before.drop_nulls("error_deg").join(after.drop_nulls("error_deg"), on=keys, suffix="_2")
    apart = (both["error_deg"] - both["error_deg_2"]).abs().drop_nulls().to_numpy()
    return f"errors differ by up to {apart.max():.2g} deg"


def _again(content: dict[str, int], mutations: tuple[Mutation, ...] = (), workers: int = 1) -> pl.DataFrame:
    """Make realisations of the bank's experiments under mutations; these are in this process alone."""
    return _made([experiment(name, count) for name, count in content.items()], mutations, workers)


def _made(experiments: list[Experiment], mutations: tuple[Mutation, ...] = (), workers: int = 1) -> pl.DataFrame:
    tables = []
    with tempfile.TemporaryDirectory() as folder, planted(*mutations):
        for each in experiments:
            engine = make_engine("local", workers)
            tables.append(run_experiment(each, Path(folder) / each.name, engine=engine).results)
    return pl.concat([table.select(*COLUMNS) for table in tables])


def rises(bank: pl.DataFrame, nights: int = DETECTION_NIGHTS) -> list[tuple[Rate, Rate]]:
    """Judge nights in which one estimator's errors are 10 % larger: paired, and of fresh seeds."""
    source = Source.of(bank)
    made = []
    for estimator in sorted(bank["estimator"].unique()):
        after = Source(raised(bank, estimator, RISE), source.unit, source.setting)
        own = bank.filter(pl.col("estimator") == estimator).group_by("experiment", "setting")
        means = own.agg(pl.col("error_deg").mean())["error_deg"].drop_nulls().to_numpy()
        margins = RISE * means / margin_of(QUANTITIES["mean_deg"], means)
        about = f"{(margins > 1).sum()} of {len(means)} settings, by {margins.max():.2g} margins at most"
        made.append(
            (
                _rate(estimator, Paired(source, after, N), nights, about=about),
                _rate(estimator, Fresh(source, N, after), nights),
            )
        )
    return made


def proof_experiments(realisations: int = 2 * N) -> list[Experiment]:
    """Return the experiments that faults are planted into: surfaces of all kinds, a light offset, the protocol."""
    plain = {"camera.width": 320, "camera.height": 320}
    groups = [
        {"scene": "plane", "label": "plane", "isolated": False, "set": plain},
        {"scene": "cylinder", "label": "cylinder", "isolated": False, "set": plain,
         "sweep": [{"surface.radius_mm": [30.0, 5.0]}]},
        {"scene": "sphere", "label": "sphere", "isolated": False, "set": plain},
        {"scene": "saddle", "label": "saddle", "isolated": False, "set": plain},
        {"scene": "plane", "label": "light aside", "isolated": False,
         "set": {**plain, "rig.lights.0.offset_mm": 1.0, "rig.lights.0.azimuth_deg": 50.0}},
        {"scene": "anatomy", "label": "colon", "realisations": realisations // 4,
         "set": {"camera.width": 320, "camera.height": 240, "camera.fx": 160.0, "camera.fy": 160.0},
         "pool": [{"surface.viewpoint": [1, 2, 3, 4]}]},
    ]  # fmt: skip
    estimators = ("circle_pose", "brightest_point", "cone_axis", "curved")
    published = [{"scene": "published", "label": "published", "sweep": [{"paper.sigma": [0.02, 0.05]}]}]
    return [
        Experiment(name="rendered", realisations=realisations, estimators=estimators, groups=groups),
        Experiment(name="protocol", realisations=realisations, estimators=("circle_pose",), groups=published),
    ]


def faults(nights: int = DETECTION_NIGHTS, names: tuple[str, ...] = tuple(FAULTS)) -> list[Caught]:
    """Plant each fault, and ask the laws and the gate; the first of the list is the code as it is."""
    sound = _made(proof_experiments())
    before = Source.of(sound)
    made = []
    for name, mutations in {"none": (), **{name: FAULTS[name] for name in names}}.items():
        rows: pl.DataFrame | None = None
        try:
            rows = sound if name == "none" else _made(proof_experiments(), mutations)
        except SimtestError as error:
            stopped = f"the night stops: {error}"
        with planted(*mutations):
            watch = tuple(broken for name, measure in measures().items() for broken in _broken(name, measure))
        if rows is None:
            both = (Rate(name, nights, nights, stopped),) * 2
        else:
            equal = equal_cells(sound, rows) if rows.height == sound.height else None
            after = Source.of(rows)
            both = tuple(_rate(name, draw, nights) for draw in _draws(before, after, equal))
        made.append(Caught(name, watch, *both, rows is None))
    return made


def _broken(name: str, measure: Callable[[], list[Law]]) -> list[str]:
    """Return which laws do not hold; an error breaks all that it stops."""
    try:
        return [f"{law.name} {law.quantity}" for law in measure() if not law.holds]
    except Exception:
        return [f"{name} error"]


def _draws(before: Source, after: Source, equal: pl.DataFrame | None) -> tuple[Draw, Draw]:
    return Paired(before, after, N, equal), Fresh(before, N, after)
