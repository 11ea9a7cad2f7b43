"""Fit the factors of ripples and bends to random fields of glints.

    python -m studies.ripples_fit [--fields 60] [--first 0]

Each field is put through the pictures of `PICTURES`; its highlights are found as reconstruction finds them, and those
that hold one glint are kept. A factor is the smallest with which 95 % of the errors lie in the stated 95 % regions, all
pictures together, everything else as the code states it; its interval is that of 400 resamplings of the fields. For the
bends the factor is that of their standard deviation, over highlights that a bend tells of; 1 is what the code states.
Bends and ripples come together, so that the ripples' factor is fitted with the bends as stated, and without them.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.calibration import Calibration
from simtest.calibration.photometry import NoiseModel
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.detection.colour import ColourDetector
from simtest.estimators.brightest_point import OF_APEX, budget_of_peak
from simtest.estimators.family import OF_MEAN, OF_PEAK, IsophoteFamily
from simtest.estimators.highlight import fit_highlight
from simtest.geometry import Array, Camera, Mask, Patch
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime import chi_squared
from simtest.runtime.seeds import Stage, generator
from simtest.simulation.sensor import capture, collect
from simtest.spec.sensor import Sensor
from studies.ripples_fit.fields import HEIGHT, WIDTH, Field, draw

PICTURE: dict[str, Any] = {
    "point_spread_px": 0.8, "full_well": 8000, "read_noise": 6.0, "response": {"type": "srgb"}, "bits": 8
}  # fmt: skip
PICTURES: dict[str, dict[str, Any]] = {
    "noise 0.3 %": {"point_spread_px": 0.8, "noise_sigma": 0.003},
    "noise 1 %": {"point_spread_px": 0.8, "noise_sigma": 0.01},
    "8 bits": PICTURE,
    **{f"JPEG {q}": PICTURE | {"coding": {"type": "jpeg", "quality": q}} for q in (95, 80, 60)},
    "mosaic": PICTURE | {"mosaic": {"pattern": "rggb", "demosaicing": "edge_aware"}},
    "sharpening": PICTURE | {"sharpening": {"radius_px": 1.3, "amount": 0.9}},
    "colonoscope_hd": {"preset": "colonoscope_hd", "overlay": None},
}
FULL_SCALE = 1.6
"""Light that becomes 1: the lobe's peak on the diffuse ground is 1.3."""

HALF, LARGEST, RESAMPLINGS = 0.5, 1e4, 400
FOCAL_PX = 400.0
CAMERA = Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2)
CHI2_95 = chi_squared.quantile(0.95, 2)
BENT = 0.01
"""A bend of less tells of nothing: the code adds under 2 % of the radius."""

AXES = ("mean axis", "axis at the peak", "peak")
STATED = dict(zip(AXES, (OF_MEAN, OF_PEAK, OF_APEX), strict=True))


@dataclass(frozen=True)
class Seen:
    """One axis of a highlight: its error, rad in the family's basis, and the covariance in its parts.

    `field`: number of the field; `picture`, `axis`: as in `PICTURES` and `AXES`; `error` (shape (2,)); `other`,
    `ripples`, `bends` (shape (2, 2)): everything but ripples and bends; the ripples at a factor of 1; the bends as
    stated; `bend`: least residual of the isophotes, over the radius.
    """

    field: int
    picture: str
    axis: str
    error: Array
    other: Array
    ripples: Array
    bends: Array
    bend: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.ripples_fit", description="Fit ripples and bends.")
    parser.add_argument("--fields", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args(arguments)
    seen: list[Seen] = []
    for number in range(given.first, given.first + given.fields):
        seen += _highlights(number)
        print(f"field {number}: {len(seen) // len(AXES)} highlights so far", file=sys.stderr)
    print("\n".join(_table(seen)))
    return 0


def _highlights(number: int) -> Iterator[Seen]:
    field = draw(number)
    radiance = field.radiance()
    for picture, tables in PICTURES.items():
        sensor = Sensor.model_validate(tables)
        rng = generator(19, "ripples", picture, number, Stage.SENSOR)
        frame = capture(collect(radiance, sensor, CAMERA), FULL_SCALE, sensor, rng)
        response = sensor.response.model()
        noise = NoiseModel(sensor.noise_sigma, sensor.full_well, sensor.read_noise, sensor.bits, response)
        calibration = Calibration(CAMERA, response, noise=noise, saturation_level=1.0)
        found = reconstruct(frame, calibration, {}, detector=ColourDetector())
        for specularity in found:
            if isinstance(specularity.patch, Patch):
                yield from _axes(number, field, picture, specularity.patch)


def _axes(number: int, field: Field, picture: str, patch: Patch) -> Iterator[Seen]:
    """Return the three axes of a highlight that holds one glint."""
    if patch.area_px(HALF) is None:
        return
    pixels = np.argwhere(patch.inside(HALF))[:, ::-1] + 0.5 + np.array(patch.origin_px)
    glints = field.glints(pixels)
    family = fit_highlight(patch, CAMERA, CONE_AXIS_ISOVALUES)
    if len(glints) != 1 or not isinstance(family, IsophoteFamily):
        return
    budgets = (family.axis_budget, family.peak_budget, budget_of_peak(family))
    axes = (family.axis, family.peak_axis, CAMERA.unproject(patch.peak_px))
    true = CAMERA.unproject(glints[0])
    for name, axis, budget in zip(AXES, axes, budgets, strict=True):
        if budget is not None:
            bends, ripples = family.bend_error(STATED[name].bends), family.ripple_error
            other = sum(budget.values()) - bends - STATED[name].ripples * ripples
            error = family.basis @ (axis - true)
            yield Seen(number, picture, name, error, other, ripples, bends, float(family.residuals.min()))


def _beyond(seen: Sequence[Seen], ripples: Array, bends: Array) -> Mask:
    """Return which errors lie outside of their regions at factors of each one's ripples and bends, shape (N,)."""
    errors, other, rippled, bent = (
        np.array([getattr(each, name) for each in seen]) for name in ("error", "other", "ripples", "bends")
    )
    covariance = other + ripples[:, None, None] * rippled + (bends**2)[:, None, None] * bent
    distance = np.sum(errors * np.linalg.solve(covariance, errors[:, :, None])[:, :, 0], axis=1)
    return np.asarray(distance > CHI2_95)


def _stated(seen: Sequence[Seen]) -> tuple[Array, Array]:
    return np.array([STATED[each.axis].ripples for each in seen], dtype=float), np.ones(len(seen))


def _least(seen: Sequence[Seen], of: str) -> Array:
    """Return the smallest factor at which each region holds its error, shape (N,): 0 where none is needed.

    `of` is "ripples", "ripples alone", without the bends, or "bends".
    """
    ripples, bends = _stated(seen)
    bends = 0 * bends if of == "ripples alone" else bends

    def short(factor: Array) -> Mask:
        return _beyond(seen, ripples, factor) if of == "bends" else _beyond(seen, factor, bends)

    low, high = np.full(len(seen), 1e-3), np.full(len(seen), LARGEST)
    none, never = ~short(np.zeros(len(seen))), short(high)
    for _ in range(40):
        middle = np.sqrt(low * high)
        too_small = short(middle)
        low, high = np.where(too_small, middle, low), np.where(too_small, high, middle)
    return np.where(none, 0.0, np.where(never, np.inf, high))


def _factor(seen: Sequence[Seen], of: str) -> str:
    """Return the factor that 95 % need no more than, with its 95 % interval over resamplings of the fields."""
    least, fields = _least(seen, of), np.array([each.field for each in seen])
    parts = [least[fields == number] for number in np.unique(fields)]
    rng = np.random.default_rng(19)
    drawn = [
        _quantile(np.concatenate([parts[i] for i in rng.choice(len(parts), len(parts))])) for _ in range(RESAMPLINGS)
    ]
    low, high = np.sort(drawn)[[int(0.025 * RESAMPLINGS), int(0.975 * RESAMPLINGS)]]
    return f"{_quantile(least):.2f} ({low:.2f} to {high:.2f})"


def _quantile(values: Array) -> float:
    return float(np.sort(values)[min(int(0.95 * len(values)), len(values) - 1)])


def _table(seen: Sequence[Seen]) -> list[str]:
    """Return the factors and the coverage of each picture as markdown."""
    made = ["| axis | highlights | ripples stated | least (interval) | least without bends | bent | bends: least |"]
    made.append("|---|---|---|---|---|---|---|")
    parts: Mapping[str, list[Seen]] = {name: [each for each in seen if each.axis == name] for name in AXES}
    for name, own in parts.items():
        bent = [each for each in own if each.bend > BENT]
        told = [_factor(own, "ripples"), _factor(own, "ripples alone"), _factor(bent, "bends") if bent else "-"]
        made.append(
            f"| {name} | {len(own)} | {STATED[name].ripples:g} | {told[0]} | {told[1]} | {len(bent)} | {told[2]} |"
        )
    made += ["", "Coverage as stated, %:", "| picture | " + " | ".join(AXES) + " |", "|---|" + "---|" * len(AXES)]
    for picture in (*PICTURES, "all"):
        cells = []
        for own in parts.values():
            part = [each for each in own if picture in ("all", each.picture)]
            cells.append(f"{100 - 100 * _beyond(part, *_stated(part)).mean():.1f} of {len(part)}" if part else "-")
        made.append(f"| {picture} | " + " | ".join(cells) + " |")
    return made


if __name__ == "__main__":
    sys.exit(main())
