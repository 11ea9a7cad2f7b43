"""Plan of a dataset: anatomies, splits, draws and shards of all samples, known before anything is rendered."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import JsonValue

from simtest.dataset.fields import FIELDS, Field
from simtest.errors import InputError
from simtest.runtime.arrays import IntArray
from simtest.runtime.resources import find
from simtest.runtime.seeds import Stage, generator, integer
from simtest.spec import AnatomySurface, Scene, apply_settings, read_toml, scene_from_dict
from simtest.spec.keys import replace_values
from simtest.spec.recipes import Dataset, Distribution, Family
from simtest.surfaces.recipe import ColonRecipe, load_recipe
from simtest.surfaces.tube import Tube

ANATOMY_KEYS = ("surface.seed", "surface.path", "surface.recipe")
"""Keys that determine an anatomy."""

BYTES_PER_PIXEL = 5.4
"""Size of a sample with its labels, as measured on the shipped datasets (docs/howto/datasets.md)."""

RELIEF_BYTES_PER_PIXEL = 6.0
"""What a relief adds: normals and curvatures of the base, and more detail in those of the fine surface."""

RADIANCE_BYTES_PER_PIXEL = 6.0
"""Size of the linear radiance: three values of 16 bits."""

ANATOMY_DRAWS = 100
"""Draws of an anatomy before one that cannot be is taken, whose error says why."""


@dataclass(frozen=True)
class Anatomy:
    """One anatomy."""

    family: int  # index of its family
    number: int  # index among the family's anatomies
    seed: int | None  # surface.seed; None if the family has only that of the scene


@dataclass(frozen=True)
class Shard:
    """Samples of one file."""

    split: str  # train, validation or test
    number: int  # index among the split's shards
    indices: tuple[int, ...]  # samples, in rising order

    @property
    def name(self) -> str:
        """File name."""
        return f"{self.split}-{self.number:06d}.tar"


@dataclass(frozen=True)
class Drawn:
    """Scene drawn for a sample."""

    scene: Scene  # with seeds of noise and bounces
    anatomy: Anatomy
    values: dict[str, JsonValue]  # drawn values by key path


class Plan:
    """Layout of a dataset: which sample is made of what, and stands in which shard.

    Parameters
    ----------
    dataset : Dataset
        What is wanted.
    """

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self._bases = [self._base(k, family) for k, family in enumerate(dataset.families)]
        self._values: dict[Anatomy, dict[str, JsonValue]] = {}
        self.has_polyps = False
        # All that each family may be.
        tried = [self._check(k, family) for k, family in enumerate(dataset.families)]
        self._files = [_anatomy_files(own) for own in tried]
        scenes = [scene for own in tried for scene in own]
        self._largest_px = max(scene.camera.width * scene.camera.height for scene in scenes)
        # Samples hold the truth of the base as well, or a map of the instruments or polyps.
        self.has_relief = any(scene.surface.relief is not None for scene in scenes)
        self.has_instruments = any(scene.instruments for scene in scenes)
        self._is_covered = any(scene.is_covered for scene in scenes)
        self._check_shared()
        self.splits, self.samples_per_anatomy = _made_small(dataset)
        self._blocks = self._lay_out()
        self._splits = self._assign()

    @cached_property
    def made_small(self) -> str:
        """What a dataset of few samples has fewer of than its recipe asks for; empty where it lacks nothing."""
        asked, what = self.dataset, []
        if self.samples_per_anatomy < asked.samples_per_anatomy:
            what.append(f"samples_per_anatomy is {self.samples_per_anatomy}, not {asked.samples_per_anatomy}")
        if empty := [name for name in asked.splits.shares if name not in self.splits]:
            what.append(f"{' and '.join(empty)}: no sample")
        return f"samples = {asked.samples}, few for the splits: {'; '.join(what)}" if what else ""

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files besides its own that determine its content: base scenes, and recipes and meshes, drawn ones too."""
        scenes = [find(family.scene, "scenes") for family in self.dataset.families]
        return tuple(
            dict.fromkeys(path for pair in zip(scenes, self._files, strict=True) for path in (pair[0], *pair[1]))
        )

    @property
    def fields(self) -> list[Field]:
        """The fields that some sample stores."""
        shown = {"relief": self.has_relief, "instruments": self.has_instruments, "polyps": self.has_polyps}
        stored = {"always": True, "covered": self._is_covered, **shown}
        return [field for field in FIELDS if stored.get(field.stored, getattr(self.dataset, field.name, False))]

    def _base(self, number: int, family: Family) -> dict[str, Any]:
        path = find(family.scene, "scenes")
        base = replace_values(Scene, read_toml(path), family.set, f"families.{number}.set")
        base.setdefault("name", f"{self.dataset.name}-{number}"[:80])
        return base

    def _check(self, number: int, family: Family) -> list[Scene]:
        """Return a family's scene and those at the ends of its ranges, of each alone and of all together.

        Raises `InputError` if one would be malformed, or one anatomy be two or differ between its samples.
        """
        where = f"families.{number}"
        drawn = {**family.per_anatomy, **family.per_sample, **self.dataset.per_sample}
        scene = scene_from_dict(self._bases[number], where)
        if family.seeds is not None and not isinstance(scene.surface, AnatomySurface):
            raise InputError(f"{where}.seeds: surface.type = {scene.surface.type} has no seed; leave it out")
        # One anatomy must not change between its samples.
        if twice := sorted({*family.per_anatomy} & {*family.per_sample, *self.dataset.per_sample}):
            raise InputError(f"{where}.per_anatomy: {twice[0]} is drawn for each sample too; must be in one of them")
        # The scene itself, then the ends of the ranges: each alone, then all lows and all highs at once.
        alone = [{path: value} for path, one in drawn.items() for value in one.ends]
        together = [{path: one.ends[end] for path, one in drawn.items()} for end in (0, -1)]
        tried = []
        for values in ({}, *alone, *together):
            tried.append(scene_from_dict(apply_settings(self._bases[number], values, where), where))
            if isinstance(tried[-1].surface, AnatomySurface):
                self._check_anatomy(where, family, tried[-1].surface)
        return tried

    def _check_anatomy(self, where: str, family: Family, surface: AnatomySurface) -> None:
        """Raise `InputError` if an anatomy is malformed, or might be in two splits."""
        for path in (*family.per_sample, *self.dataset.per_sample):
            # The key itself, one below it, or the whole surface; surface.path_share places the camera.
            if path == "surface" or any(f"{path}.".startswith(f"{key}.") for key in ANATOMY_KEYS):
                raise InputError(
                    f"{where}: {path} is drawn for each sample, which makes anatomies that may be in two splits; "
                    "must be drawn by seeds or per_anatomy"
                )
        if (file := surface.file()).suffix == ".toml":
            recipe = load_recipe(file, surface.recipe_values)
            self.has_polyps |= isinstance(recipe, ColonRecipe) and bool(recipe.polyps or recipe.polyp_count)
        elif family.seeds is not None:
            raise InputError(
                f"{where}.seeds: the mesh surface.path = {file.name} is the same for each seed and might be in two "
                "splits; must have a family of its own, without seeds"
            )

    def _check_shared(self) -> None:
        """Raise `InputError` if two families may share an anatomy, which might then be in two splits."""
        held: list[tuple[int, Path, range | None]] = []
        for number, family in enumerate(self.dataset.families):
            surface, seeds = scene_from_dict(self._bases[number], f"families.{number}").surface, None
            if family.seeds is not None:
                seeds = range(family.seeds.low, family.seeds.high + 1)
            elif isinstance(surface, AnatomySurface) and surface.seed is not None:
                seeds = range(surface.seed, surface.seed + 1)
            # A recipe makes another anatomy of each seed; a mesh is the same one always.
            own = [(file.resolve(), seeds if file.suffix == ".toml" else None) for file in self._files[number]]
            for (file, seeds), (other, its_file, its_seeds) in product(own, held):
                apart = (
                    seeds is not None
                    and its_seeds is not None
                    and (max(seeds.start, its_seeds.start) >= min(seeds.stop, its_seeds.stop))
                )
                if file == its_file and not apart:
                    raise InputError(
                        f"families.{number}: has surface.path = {file.name} in common with families.{other}, and an "
                        "anatomy might be in two splits; must have seeds that do not overlap"
                    )
            held += [(number, *each) for each in own]

    # Anatomies and splits ------------------------------------------------------------------------------------------

    def _rng(self, branch: str, number: int = 0) -> np.random.Generator:
        return generator(self.dataset.seed, self.dataset.name, branch, number, Stage.SWEEP)

    def _lay_out(self) -> list[Anatomy]:
        """Return the anatomy of each block of `samples_per_anatomy` samples."""
        dataset = self.dataset
        count = -(-dataset.samples // self.samples_per_anatomy)
        counts = _shared(count, [family.weight for family in dataset.families])
        blocks = []
        for k, (family, wanted) in enumerate(zip(dataset.families, counts, strict=True)):
            if family.seeds is None:
                blocks += [Anatomy(k, 0, None)] * wanted
                continue
            if wanted > family.seeds.count:
                raise InputError(
                    f"families.{k}.seeds: {wanted} anatomies are needed for {dataset.samples} samples and low to high "
                    f"has {family.seeds.count}; must have as many, or samples_per_anatomy be larger"
                )
            seeds = self._rng(f"seeds {k}").choice(family.seeds.count, size=wanted, replace=False)
            blocks += [Anatomy(k, n, family.seeds.low + int(seed)) for n, seed in enumerate(seeds)]
        # Shuffled, so that neighbouring blocks are of different families.
        order = self._rng("order").permutation(len(blocks))
        return [blocks[i] for i in order]

    def _assign(self) -> dict[Anatomy, str]:
        """Return the split of each anatomy: each in turn goes to the split that lacks most samples."""
        # samples of each anatomy
        sizes: dict[Anatomy, int] = {}
        for block, anatomy in enumerate(self._blocks):
            sizes[anatomy] = sizes.get(anatomy, 0) + len(self._block_indices(block))
        shares = self.splits
        if len(sizes) < len(shares):
            raise InputError(
                f"splits: {len(sizes)} anatomies for {len(shares)} splits ({', '.join(shares)}); no anatomy may be in "
                "two: give more families or seeds, or fewer splits"
            )
        lacking = {name: share * self.dataset.samples for name, share in shares.items()}
        assigned: dict[Anatomy, str] = {}
        empty = set(shares)
        # The largest first; once only as many are left as there are empty splits, the empty ones get them.
        for left, anatomy in zip(range(len(sizes), 0, -1), sorted(sizes, key=lambda a: -sizes[a]), strict=True):
            among = empty if left <= len(empty) else shares
            chosen = max((name for name in shares if name in among), key=lambda name: lacking[name])
            assigned[anatomy] = chosen
            lacking[chosen] -= sizes[anatomy]
            empty.discard(chosen)
        return assigned

    def _block_indices(self, block: int) -> range:
        size = self.samples_per_anatomy
        return range(block * size, min((block + 1) * size, self.dataset.samples))

    def anatomy(self, index: int) -> Anatomy:
        """Return the anatomy of a sample."""
        return self._blocks[index // self.samples_per_anatomy]

    def split(self, index: int) -> str:
        """Return the split of a sample."""
        return self._splits[self.anatomy(index)]

    # Shards ----------------------------------------------------------------------------------------------------------

    @cached_property
    def samples_per_shard(self) -> int:
        """How many samples of the size expected of the largest frames a shard holds; depends on the dataset alone."""
        size = BYTES_PER_PIXEL + (RADIANCE_BYTES_PER_PIXEL if self.dataset.radiance else 0)
        size += RELIEF_BYTES_PER_PIXEL if self.has_relief else 0
        return max(1, int(self.dataset.shard_mb * 1e6 / (size * self._largest_px)))

    @cached_property
    def shards(self) -> tuple[Shard, ...]:
        """All shards."""
        indices: dict[str, list[int]] = {name: [] for name in self.splits}
        for block, anatomy in enumerate(self._blocks):
            indices[self._splits[anatomy]] += self._block_indices(block)
        size = self.samples_per_shard
        return tuple(
            Shard(split, number, tuple(members[first : first + size]))
            for split, members in indices.items()
            for number, first in enumerate(range(0, len(members), size))
        )

    def shard_of(self, index: int) -> Shard:
        """Return the shard that holds a sample."""
        return next(shard for shard in self.shards if index in shard.indices)

    # Scenes ----------------------------------------------------------------------------------------------------------

    def draw(self, index: int, attempt: int = 0) -> Drawn:
        """Draw a sample's scene.

        `attempt` numbers the draws of all that differs between samples; the anatomy stays. Raises `InputError` if the
        drawn values contradict each other.
        """
        dataset, anatomy = self.dataset, self.anatomy(index)
        family = dataset.families[anatomy.family]
        # Each draw has a branch of the seed tree of its own, so no sample depends on another.
        own = _draw({**family.per_sample, **dataset.per_sample}, self._rng(f"attempt {attempt}", index))
        values = self._values_of(anatomy) | own
        seeds = {
            "sensor.seed": integer(dataset.seed, dataset.name, "sample", index, Stage.SENSOR),
            "render.seed": integer(dataset.seed, dataset.name, "sample", index, Stage.RENDER) % 2**32,
        }
        where = f"{dataset.name}, sample {index}"
        data = apply_settings(self._bases[anatomy.family], {**values, **seeds}, where)
        return Drawn(scene_from_dict(data, where), anatomy, values)

    def _values_of(self, anatomy: Anatomy) -> dict[str, JsonValue]:
        """Return what is drawn of an anatomy: the first of `ANATOMY_DRAWS` draws that can be, or else the last.

        Ranges that are sound at their ends may close a colon together: deep folds that stand close in a narrow tube.
        """
        if anatomy not in self._values:
            family, rng = self.dataset.families[anatomy.family], self._rng(f"anatomy {anatomy.family}", anatomy.number)
            for _ in range(ANATOMY_DRAWS):
                values = _draw(family.per_anatomy, rng)
                if anatomy.seed is not None:
                    values["surface.seed"] = anatomy.seed
                where = f"families.{anatomy.family}"
                scene = scene_from_dict(apply_settings(self._bases[anatomy.family], values, where), where)
                if _can_be(scene.surface):
                    break
            self._values[anatomy] = values
        return self._values[anatomy]


def _can_be(surface: object) -> bool:
    """Return whether a surface is no colon that its folds close, or that bends into itself."""
    if isinstance(surface, AnatomySurface) and surface.file().suffix == ".toml":
        try:
            recipe = load_recipe(surface.file(), surface.recipe_values)
            if isinstance(recipe, ColonRecipe):
                Tube(recipe)
        except InputError:
            return False
    return True


def _made_small(dataset: Dataset) -> tuple[dict[str, float], int]:
    """Return the shares of the splits, and the samples of an anatomy; of both there are fewer where samples are few."""
    shares, each = dataset.splits.shares, dataset.samples_per_anatomy
    if dataset.samples > each * (len(shares) - 1):
        return shares, each
    largest = sorted(shares, key=lambda name: -shares[name])[: dataset.samples]
    return {name: share for name, share in shares.items() if name in largest}, max(1, dataset.samples // len(shares))


def _anatomy_files(scenes: list[Scene]) -> list[Path]:
    """Return the recipes and meshes of scenes, each once, in their order."""
    return list(dict.fromkeys(s.surface.file() for s in scenes if isinstance(s.surface, AnatomySurface)))


def _draw(drawn: Mapping[str, Distribution], rng: np.random.Generator) -> dict[str, JsonValue]:
    # By name, so that the order of keys in the file does not matter.
    return {path: drawn[path].draw(rng) for path in sorted(drawn)}


def _shared(count: int, weights: list[float]) -> list[int]:
    """Divide a number by weights; the largest remainders are rounded up."""
    exact = count * np.asarray(weights) / sum(weights)
    whole: IntArray = np.floor(exact).astype(np.int64)
    for i in np.argsort(whole - exact, kind="stable")[: count - int(whole.sum())]:
        whole[i] += 1
    return [int(n) for n in whole]
