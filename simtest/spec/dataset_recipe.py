"""Recipe of a dataset: which anatomies, what is drawn for each of them and for each sample, how many, what is kept."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from simtest.runtime.boundary import plain_errors
from simtest.runtime.resources import find
from simtest.spec.experiment import check_first_parts, replaced, still_varied
from simtest.spec.scene import Scene
from simtest.spec.spec_model import Name, Share, Spec, load

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
        if self.low > self.high:
            raise ValueError(f"low = {self.low:g} must not exceed high = {self.high:g}")
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
    """Shares of the samples; no anatomy is in two of them."""

    train: Share = 0.8
    validation: Share = 0.1
    test: Share = 0.1

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
        if self.low > self.high:
            raise ValueError(f"low = {self.low} must not exceed high = {self.high}")
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

    name: Name
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
    settings = dict(settings or {})
    own = {key: settings.pop(key) for key in list(settings) if key.split(".")[0] in _DATASET_KEYS}
    check_first_parts(settings, Scene.model_fields, _DATASET_KEYS)
    dataset = load(Dataset, path, own)
    if not settings:
        return dataset

    # A value that is set is no longer drawn.
    def left(drawn: dict[str, Distribution]) -> dict[str, Distribution]:
        kept = still_varied(drawn, settings, "dataset")
        return {key: value for key, value in drawn.items() if key in kept}

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
