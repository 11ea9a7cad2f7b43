"""A bank: frames of a recipe over the ranges that can be fitted, as parameters and summaries. It resumes."""

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import JsonValue

from simtest.dataset.plan import Anatomy, Drawn, Plan
from simtest.errors import InputError
from simtest.realism.compare import Progress
from simtest.reconstruction.statistics import NAMES, measure, summarise
from simtest.runtime.arrays import Array, Image, IntArray, only_reading
from simtest.runtime.files import Json, make_folder, read_json, write_json
from simtest.runtime.provenance import source_hash
from simtest.runtime.seeds import Stage, generator, integer
from simtest.spec import Scene, apply_settings
from simtest.spec.recipes import Dataset, Distribution, Splits
from simtest.spec.sensor import Sensor

if TYPE_CHECKING:
    from simtest.rendering import Session

KNOWN: tuple[tuple[str, str, str], ...] = (
    ("relief slope", r"surface\.relief\.bands\.\d+\.slope_deg", "deg"),
    ("relief wavelength", r"surface\.relief\.bands\.\d+\.wavelength_mm", "mm"),
    ("film roughness", r"reflectance\.film\.alpha", ""),
    ("film level", r"reflectance\.film\.level", "deviations of the relief"),
    ("film patches", r"reflectance\.film\.patches\.(wavelength_mm|amplitude|dry_level)", ""),
    ("colour of the tissue", r"reflectance\.albedo\.(base\.\d|blood)", ""),
    ("texture contrast", r"reflectance\.albedo\.(mottling\.amplitude|vessels\.strength|capillaries\.strength)", ""),
    ("exposure", r"sensor\.exposure\.(average|centre|percentile|gain|full_scale)", ""),
    ("vignetting", r"sensor\.vignetting\.power", ""),
    ("profile of the light", r"rig\.(each|lights\.\d+)\.profile\.power", ""),
    ("source size", r"rig\.(each|lights\.\d+)\.source\.radius_mm", "mm"),
    ("distance", r"surface\.(distance_mm|recipe\.radius_mm|radius_mm|off_axis_share|look_ahead_mm)", ""),
    ("sharpening", r"sensor\.sharpening\.(amount|radius_px)", ""),
    ("noise", r"sensor\.(full_well|read_noise|noise_sigma|denoising\.(radius_px|level))", ""),
    ("point spread", r"sensor\.point_spread_px", "px"),
)
"""What can be fitted: its name, the key paths that hold it, and its unit where all of them share one."""


@dataclass(frozen=True)
class RecipeParameter:
    """A range of a recipe that is fitted."""

    kind: str  # what it is, one of `KNOWN`
    key: str  # key path of the scene
    prior: Distribution  # the recipe's range
    table: str  # where it stands: per_anatomy or per_sample of the family, or shared by all families

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends of the range, in logarithms where it is even in them."""
        low, high = (float(end) for end in self.prior.ends)
        return (float(np.log(low)), float(np.log(high))) if self.prior.log else (low, high)

    def to_unit(self, values: Array) -> Array:
        """Return values as shares of the range, of its logarithm where it is even in that; same shape."""
        low, high = self.ends
        return np.asarray(((np.log(values) if self.prior.log else values) - low) / (high - low))

    def from_unit(self, shares: Array) -> Array:
        """Return the values at shares of the range."""
        low, high = self.ends
        value = low + np.asarray(shares) * (high - low)
        return np.asarray(np.exp(value) if self.prior.log else value)


def one_family(dataset: Dataset, scene: str | None = None) -> Dataset:
    """Return a recipe with the one family that is to be fitted, by its base scene where there are several."""
    names = [family.scene for family in dataset.families]
    found = [family for family in dataset.families if scene is None or family.scene == scene]
    if len(found) != 1:
        what = f"--scene {scene}" if scene else "--scene is needed where a recipe has several families"
        raise InputError(f"{dataset.name}: {what}; must name one of its base scenes: {', '.join(sorted(set(names)))}")
    return dataset.model_copy(update={"families": tuple(found)})


def fitted_parameters(dataset: Dataset) -> list[RecipeParameter]:
    """Return the parameters of a recipe of one family, in the order of `KNOWN`, then by key."""
    family = dataset.families[0]
    tables = {"per_anatomy": family.per_anatomy, "per_sample": family.per_sample, "shared": dataset.per_sample}
    found = []
    for kind, pattern, _ in KNOWN:
        ranges = [RecipeParameter(kind, key, prior, name)
                  for name, table in tables.items() for key, prior in table.items()
                  if re.fullmatch(pattern, key)]  # fmt: skip
        found += sorted(ranges, key=lambda one: one.key)
    # A choice has no width, and neither has a range of one value.
    wide = [p for p in found if not p.prior.choose and not p.prior.integer and p.prior.ends[0] < p.prior.ends[1]]
    if not wide:
        kinds = ", ".join(kind for kind, _, _ in KNOWN)
        raise InputError(f"{dataset.name}: no range with low and high that can be fitted; must draw one of: {kinds}")
    return wide


def missing_kinds(parameters: list[RecipeParameter]) -> list[str]:
    """Return the kinds of parameters that a recipe does not draw, and that no frames can tell of it."""
    drawn = {parameter.kind for parameter in parameters}
    return [kind for kind, _, _ in KNOWN if kind not in drawn]


def narrowed(dataset: Dataset, parameters: list[RecipeParameter], low: Array, high: Array) -> Dataset:
    """Return a recipe of one family whose ranges reach from `low` to `high`, shape (P,), shares of the prior's."""
    family = dataset.families[0]
    tables = {name: dict(getattr(family, name)) for name in ("per_anatomy", "per_sample")}
    tables["shared"] = dict(dataset.per_sample)
    for parameter, first, last in zip(parameters, low, high, strict=True):
        # Five digits: a recipe is read by people.
        ends = (float(f"{end:.5g}") for end in parameter.from_unit(np.clip([first, last], 0.0, 1.0)))
        tables[parameter.table][parameter.key] = Distribution(
            **dict(zip(("low", "high"), ends, strict=True)), log=parameter.prior.log
        )
    shared = tables.pop("shared")
    return dataset.model_copy(update={"families": (family.model_copy(update=tables),), "per_sample": shared})


TRIES = 8
"""Draws of a frame before one that cannot be placed is given up."""


@dataclass(frozen=True)
class DrawnFrame:
    """A picture of a recipe, encoded values in [0, 1], shape (H, W, 3), and what was drawn for it, by key path."""

    values: dict[str, JsonValue]
    picture: Image


class FrameMaker:
    """Renders frames of a recipe, all of whose ranges are drawn, without the labels of `simtest dataset`."""

    def __init__(self, dataset: Dataset, variant: str | None = None) -> None:
        # Imported here, as below: a bank that is complete needs no renderer.
        from simtest.rendering.backend import colour_variant

        self.dataset = dataset
        self.plan = Plan(dataset)
        self._variant = colour_variant(variant)
        self._session: Session | None = None
        self._anatomy: Anatomy | None = None

    def frames(self, index: int, chains: int) -> Iterator[DrawnFrame]:
        """Render one radiance and yield its pictures, each by another draw of the sensor; the first is the sample's."""
        from simtest.simulation.frame import render_picture
        from simtest.simulation.sensor import displayed

        drawn = self.plan.draw(index)
        for attempt in range(1, TRIES + 1):
            try:
                session = self._at(drawn.anatomy, drawn.scene)
                break
            except InputError:
                # A drawn camera or light may stand in the wall: the recipe itself draws again too.
                if attempt == TRIES:
                    raise
                drawn = self.plan.draw(index, attempt)
        radiance = session.radiance()
        for chain in range(chains):
            values, scene = (drawn.values, drawn.scene) if chain == 0 else self._redrawn(index, chain, drawn)
            picture = displayed(render_picture(session, scene, radiance), scene.sensor)
            yield DrawnFrame(values, picture)

    def _redrawn(self, index: int, chain: int, drawn: Drawn) -> tuple[dict[str, JsonValue], Scene]:
        """Draw the sensor's values again, with other noise."""
        family, name, seed = self.dataset.families[drawn.anatomy.family], self.dataset.name, self.dataset.seed
        rng = generator(seed, name, f"chain {chain}", index, Stage.SENSOR)
        tables = {**family.per_anatomy, **family.per_sample, **self.dataset.per_sample}
        values = {key: tables[key].draw(rng) for key in sorted(tables) if key.startswith("sensor.")}
        noise = {"sensor.seed": integer(seed, name, f"noise {chain}", index, Stage.SENSOR)}
        table = {"sensor": drawn.scene.sensor.model_dump(mode="json")}
        sensor = apply_settings(table, {**values, **noise}, name)["sensor"]
        scene = drawn.scene.model_copy(update={"sensor": Sensor.model_validate(sensor)})
        return drawn.values | values, scene

    def _at(self, anatomy: Anatomy, scene: Scene) -> "Session":
        from simtest.rendering import Session, backend
        from simtest.surfaces.factory import forget_meshes

        if self._session is not None and anatomy != self._anatomy:
            # As in `simtest dataset`: an anatomy never comes back, and neither its memory nor its files must add up.
            self._session = None
            forget_meshes()
            backend.release_memory()
        with only_reading():
            if self._session is None:
                self._session, self._anatomy = Session(scene, self._variant), anatomy
            self._session.update(scene)
        return self._session


CHAINS = 3
"""Pictures of one radiance: the camera chain is cheap beside it."""

FRAMES_PER_ANATOMY = 5
"""Radiances of one anatomy: making one takes as long as three of them at 640 x 480 px."""

MADE_ANEW = ("surface.recipe", "surface.path", "reflectance.albedo")
"""Keys of which each value is another anatomy, or a pattern of its own, which takes as long."""


@dataclass(frozen=True)
class Bank:
    """Pictures over the ranges of a recipe."""

    shares: Array  # shape (N, P), their parameters as shares of the ranges
    summaries: Array  # shape (N, S), see `summarise`; NaN where a picture does not tell one
    radiance: IntArray  # shape (N,), which of them are of one radiance

    def ends(self) -> tuple[Array, Array]:
        """Return the least and the largest value of each summary, shape (S,); infinite where no picture tells it."""
        known = np.isfinite(self.summaries)
        low = np.where(known, self.summaries, np.inf).min(axis=0)
        return np.asarray(low), np.asarray(np.where(known, self.summaries, -np.inf).max(axis=0))

    def chosen(self, rows: IntArray) -> "Bank":
        """Return the bank of these rows."""
        return Bank(self.shares[rows], self.summaries[rows], self.radiance[rows])


def bank_recipe(dataset: Dataset, size: int) -> Dataset:
    """Return the recipe whose samples are a bank: few of each anatomy, and each with values of its own."""
    family = dataset.families[0]
    kept = {key: one for key, one in family.per_anatomy.items() if key.startswith(MADE_ANEW)}
    moved = {key: one for key, one in family.per_anatomy.items() if key not in kept}
    family = family.model_copy(update={"per_anatomy": kept, "per_sample": {**moved, **family.per_sample}})
    update = {"families": (family,), "samples": size, "samples_per_anatomy": FRAMES_PER_ANATOMY, "highlights": 0}
    return dataset.model_copy(update={**update, "splits": Splits(train=1.0, validation=0.0, test=0.0)})


def make_bank(
    dataset: Dataset,
    parameters: Sequence[RecipeParameter],
    folder: Path,
    size: int,
    chains: int = CHAINS,
    progress: Progress | None = None,
) -> Bank:
    """Render a bank of a recipe of one family, or what is missing of it.

    The folder holds a file for each of `size` radiances, with `chains` pictures; another recipe's is refused.
    """
    recipe = bank_recipe(dataset, size)
    _claim(recipe, folder, chains)
    maker = None
    for index in range(size):
        path = folder / f"{index:06d}.json"
        if not path.is_file():
            maker = maker or FrameMaker(recipe)
            write_json(path, [_row(frame, parameters) for frame in maker.frames(index, chains)])
        if progress:
            progress(index + 1, size, "rendering the bank")
    return read_bank(folder, size, parameters)


def count_made(folder: Path) -> int:
    """Return how many radiances a folder holds, counted from the first without a gap: those of a stopped bank."""
    count = 0
    while (folder / f"{count:06d}.json").is_file():
        count += 1
    return count


def read_bank(folder: Path, size: int, parameters: Sequence[RecipeParameter]) -> Bank:
    """Read the first `size` radiances of a bank; those that could not be measured are left out."""
    shares, summaries, radiance, reason = [], [], [], ""
    for index in range(size):
        path = folder / f"{index:06d}.json"
        try:
            rows = read_json(path)
            for row in rows:
                told = [np.nan if value is None else value for value in row["summaries"]]
                values = [row["values"][parameter.key] for parameter in parameters]
                if len(told) == len(NAMES):
                    shares.append([float(p.to_unit(np.array(v))) for p, v in zip(parameters, values, strict=True)])
                    summaries.append(told)
                    radiance.append(index)
                else:
                    reason = str(row["left_out"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: no file of a bank ({error}); remove it, and it is made again") from error
    if not shares:
        raise InputError(f"{folder}: the bank holds no frame that can be measured ({reason})")
    return Bank(np.array(shares), np.array(summaries, dtype=float), np.array(radiance))


def _row(frame: DrawnFrame, parameters: Sequence[RecipeParameter]) -> dict[str, Json]:
    """Return what is kept of a picture."""
    try:
        told: Sequence[float] = summarise(measure(frame.picture)).tolist()
        reason = None
    except InputError as error:
        told, reason = (), str(error)
    values: dict[str, Json] = {parameter.key: frame.values[parameter.key] for parameter in parameters}
    return {"values": values, "summaries": [v if math.isfinite(v) else None for v in told], "left_out": reason}


def _claim(recipe: Dataset, folder: Path, chains: int) -> None:
    """Note what a folder's bank is of, or raise `InputError` if it is of something else."""
    make_folder(folder)
    path = folder / "bank.json"
    # A larger bank of the same recipe goes on from a smaller one only where the plan is the same.
    wanted: dict[str, Any] = {"chains": chains, "recipe": recipe.model_dump(mode="json"), "summaries": list(NAMES)}
    wanted["source"] = source_hash()
    if not path.is_file():
        write_json(path, wanted)
        return
    try:
        held = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; remove the folder") from None
    if held != json.loads(json.dumps(wanted)):
        raise InputError(
            f"{folder}: holds the bank of another recipe, seed, size or release of simtest; remove it or name "
            "another --out"
        )
