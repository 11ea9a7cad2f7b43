"""Sorts the settings of a run into situations: settings of one kind of light, surface, relief, noise and spot."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

FLAT = 0.05
"""A curvature times distance below this size counts as none: the surface bends by less than 1/20 of its distance."""

CO_LOCATED = 1e-3
"""A light nearer to the camera than this share of the distance counts as at the camera; it costs below 0.03 deg."""

SMALL_SPOT_PX = 3.0
"""Radius at half height below which isophotes carry no shape (`simtest.estimators.small_spots`)."""

FAR_BESIDE = 0.11
"""Light offset over distance above which a light counts as far beside the camera: 0.1, and what a tilt adds to it."""

MIXED = "mixed curvature"

_USUAL = {"direct highlight alone", "pinhole camera", "resolved spot", "smooth surface"}
"""What is not worth a word where other situations differ from it."""

_ANALYTIC = {"plane", "cylinder", "sphere", "quadric"}

_TOLD = ("reflectance", "emission", "relief", "sensor", "render", "camera")


@dataclass(frozen=True)
class Situation:
    """A kind of setting.

    Parameters
    ----------
    surface : str
        Kind of surface, in words; of computed frames, what is varied.
    circumstances : str
        What else sets it apart from the run's other situations: light, lobe, noise, relief, spot; may be empty.
    settings : tuple of str
        Its settings.
    labels : tuple of str
        Names of its curves.
    """

    surface: str
    circumstances: str
    settings: tuple[str, ...]
    labels: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Both, as one phrase."""
        return ", ".join(part for part in (self.surface, self.circumstances) if part)


def situations_of(
    true: pl.DataFrame, conditions: Mapping[str, Mapping[str, object]]
) -> tuple[tuple[str, ...], list[Situation]]:
    """Sort the settings of true highlights into situations.

    Parameters
    ----------
    true : polars.DataFrame
        Rows of results.parquet with a true highlight.
    conditions : mapping
        Conditions of each setting (`simtest.validation.conditions`); may be empty.

    Returns
    -------
    shared : tuple of str
        What holds in all situations.
    situations : list of Situation
        In the order of appearance, those of the same circumstances together.
    """
    kinds: dict[tuple[str, ...], list[str]] = {}
    parts = {str(name): part for (name,), part in true.group_by("setting", maintain_order=True)}
    for setting, part in parts.items():
        kinds.setdefault(_kind(part, conditions.get(setting, {})), []).append(setting)
    varying = [len(set(values)) > 1 for values in zip(*kinds, strict=True)]
    # A surface is always named: without one the others say nothing.
    varying[:1] = [True]
    shared = tuple(text for text, varies in zip(next(iter(kinds), ()), varying, strict=False) if text and not varies)
    found = []
    for kind, settings in kinds.items():
        rows = pl.concat([parts[setting] for setting in settings])
        told = [text for text, varies in zip(kind, varying, strict=True) if text and varies]
        circumstances = ", ".join(text for text in told[1:] if text not in _USUAL)
        labels = tuple(str(label) for label in rows["label"].unique(maintain_order=True))
        found.append(Situation(told[0], circumstances, tuple(settings), labels))
    order = list(dict.fromkeys(situation.circumstances for situation in found))
    return shared, sorted(found, key=lambda situation: order.index(situation.circumstances))


def _kind(rows: pl.DataFrame, told: Mapping[str, object]) -> tuple[str, ...]:
    """Return what kind of setting some highlights belong to: a phrase for each aspect, empty for one not known."""
    if rows["kd_min"].null_count() == rows.height:
        # The published protocol computes its frames; the label names what it varies.
        return (str(rows["label"][0]), "", "", *("" for _ in _TOLD))
    names = [str(name) for name in rows["surface"].drop_nulls().unique(maintain_order=True)]
    surface = _surface(rows)
    if set(names) - _ANALYTIC:
        surface = f"{', '.join(names)}: {surface}"
    return (surface, _light(rows, told), _spot(rows, told), *(str(told.get(name) or "") for name in _TOLD))


def _surface(rows: pl.DataFrame) -> str:
    """Name the kind of surface at some highlights by the signs of their principal curvatures.

    Under a relief these are the base's: the fine surface bends both ways within every cloud.
    """
    low, high = (_of_base(rows, name).drop_nulls().to_numpy() for name in ("kd_min", "kd_max"))
    # A curvature that lies within the limit at all highlights is none; one that changes sign is mixed.
    signs = [_sign(values) for values in (low, high)]
    names = {
        (0, 0): "flat", (0, 1): "outside of a tube", (-1, 0): "inside of a tube", (1, 1): "dome", (-1, -1): "bowl",
        (-1, 1): "saddle",
    }  # fmt: skip
    return MIXED if None in signs else names[signs[0] or 0, signs[1] or 0]


def _of_base(rows: pl.DataFrame, name: str) -> pl.Series:
    """Return a column of the base, and of the fine surface where the base has none."""
    base = f"{name}_base"
    return rows.select(pl.coalesce(base, name)).to_series() if base in rows.columns else rows[name]


def _sign(values: np.ndarray) -> int | None:
    """Return the sign that curvatures share, 0 for none; None where they do not."""
    found = set(np.where(np.abs(values) < FLAT, 0, np.sign(values)).astype(int).tolist())
    return found.pop() if len(found) == 1 else None


def _light(rows: pl.DataFrame, told: Mapping[str, object]) -> str:
    lights = rows["n_lights"].drop_nulls() if "n_lights" in rows.columns else pl.Series([1])
    count = int(lights[0]) if lights.len() else 1
    name = "light" if count == 1 else f"{count} lights"
    largest = rows["eps_over_d"].abs().max()
    if largest is None or float(largest) <= CO_LOCATED:  # type: ignore[arg-type]
        return f"{name} at the camera"
    degree = "ε/d up to 0.1" if float(largest) <= FAR_BESIDE else "ε/d above 0.1"  # type: ignore[arg-type]
    return ", ".join(part for part in (f"{name} beside the camera ({degree})", str(told.get("told") or "")) if part)


def _spot(rows: pl.DataFrame, told: Mapping[str, object]) -> str:
    """Name the size of the highlights: the half-width of the lobe, shrunk by the surface's own turn."""
    half_width, focal = told.get("half_width_rad"), told.get("focal_px")
    if not isinstance(half_width, float) or not isinstance(focal, float):
        return ""
    stretch = np.abs((1 + rows["kd_min"].to_numpy()) * (1 + rows["kd_max"].to_numpy()))
    radius = focal * half_width / np.sqrt(np.nanmedian(np.maximum(stretch, 1e-6)))
    return "small spot (below 3 px)" if radius < SMALL_SPOT_PX else "resolved spot"
