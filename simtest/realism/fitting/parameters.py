"""The ranges of a recipe that can be fitted to frames, and their unit coordinates."""

import re
from dataclasses import dataclass

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.spec.recipes import Dataset, Distribution, Family

KNOWN: tuple[tuple[str, str, str], ...] = (
    ("relief slope", r"surface\.relief\.bands\.\d+\.slope_deg", "deg"),
    ("relief wavelength", r"surface\.relief\.bands\.\d+\.wavelength_mm", "mm"),
    ("film roughness", r"reflectance\.film\.alpha", ""),
    ("film level", r"reflectance\.film\.level", "deviations of the relief"),
    ("colour of the tissue", r"reflectance\.albedo\.(base\.\d|blood)", ""),
    ("texture contrast", r"reflectance\.albedo\.(mottling\.amplitude|vessels\.strength|capillaries\.strength)", ""),
    ("exposure", r"sensor\.exposure\.(average|percentile|gain|full_scale)", ""),
    ("vignetting", r"sensor\.vignetting\.power", ""),
    ("profile of the light", r"rig\.(each|lights\.\d+)\.profile\.power", ""),
    ("source size", r"rig\.(each|lights\.\d+)\.source\.radius_mm", "mm"),
    ("distance", r"surface\.(distance_mm|recipe\.radius_mm|radius_mm|off_axis_share)", ""),
    ("sharpening", r"sensor\.sharpening\.(amount|radius_px)", ""),
    ("noise", r"sensor\.(full_well|read_noise|noise_sigma)", ""),
    ("point spread", r"sensor\.point_spread_px", "px"),
)
"""What can be fitted: its name, the key paths that hold it, and its unit where all of them share one."""


@dataclass(frozen=True)
class Parameter:
    """A range of a recipe that is fitted.

    Parameters
    ----------
    kind : str
        What it is, one of `KNOWN`.
    key : str
        Key path of the scene.
    prior : Distribution
        The recipe's range.
    table : str
        Where the range stands: per_anatomy or per_sample of the family, or shared by all families.
    """

    kind: str
    key: str
    prior: Distribution
    table: str

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
    """Return a recipe with the one family that is to be fitted.

    Parameters
    ----------
    dataset : Dataset
        The recipe.
    scene : str, optional
        Base scene of the family; may be left out where there is only one.
    """
    names = [family.scene for family in dataset.families]
    found = [family for family in dataset.families if scene is None or family.scene == scene]
    if len(found) != 1:
        what = f"--scene {scene}" if scene else "--scene is needed where a recipe has several families"
        raise InputError(f"{dataset.name}: {what}; must name one of its base scenes: {', '.join(sorted(set(names)))}")
    return dataset.model_copy(update={"families": tuple(found)})


def fitted_parameters(dataset: Dataset) -> list[Parameter]:
    """Return the parameters of a recipe of one family, in the order of `KNOWN`, then by key."""
    family = dataset.families[0]
    tables = {"per_anatomy": family.per_anatomy, "per_sample": family.per_sample, "shared": dataset.per_sample}
    found = []
    for kind, pattern, _ in KNOWN:
        ranges = [(key, prior, name) for name, table in tables.items() for key, prior in table.items()
                  if re.fullmatch(pattern, key) and _has_width(prior)]  # fmt: skip
        found += [Parameter(kind, *one) for one in sorted(ranges, key=lambda one: one[0])]
    if not found:
        kinds = ", ".join(kind for kind, _, _ in KNOWN)
        raise InputError(f"{dataset.name}: no range with low and high that can be fitted; must draw one of: {kinds}")
    return found


def missing_kinds(parameters: list[Parameter]) -> list[str]:
    """Return the kinds of parameters that a recipe does not draw, and that no frames can tell of it."""
    drawn = {parameter.kind for parameter in parameters}
    return [kind for kind, _, _ in KNOWN if kind not in drawn]


def _has_width(prior: Distribution) -> bool:
    return not prior.choose and not prior.integer and prior.ends[0] < prior.ends[1]


def narrowed(dataset: Dataset, parameters: list[Parameter], low: Array, high: Array) -> Dataset:
    """Return a recipe of one family whose ranges reach from `low` to `high`, shape (P,), shares of the prior's."""
    tables = {"per_anatomy": dict(dataset.families[0].per_anatomy), "per_sample": dict(dataset.families[0].per_sample)}
    shared = dict(dataset.per_sample)
    for parameter, first, last in zip(parameters, low, high, strict=True):
        ends = parameter.from_unit(np.clip([first, last], 0.0, 1.0))
        table = shared if parameter.table == "shared" else tables[parameter.table]
        table[parameter.key] = Distribution(low=_plain(ends[0]), high=_plain(ends[1]), log=parameter.prior.log)
    family: Family = dataset.families[0].model_copy(update=tables)
    return dataset.model_copy(update={"families": (family,), "per_sample": shared})


def _plain(value: float) -> float:
    """Return a number of five digits: a recipe is read by people."""
    return float(f"{value:.5g}")
