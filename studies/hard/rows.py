"""The rows of the corpus: what each changes of a scene, of its sensor, and of what reconstruction is told."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from studies.hard.scenes import VESSELS, Tables, at_distance, base_slope_deg, kind_of, relief, rng_of

PICTURE: Tables = {"response": {"type": "srgb"}, "bits": 8}
EXPOSURE_S = 1 / 60

PRIOR_OFFSET_MM, PRIOR_DISTANCE_MM = (0.0, 6.0), (5.0, 80.0)
"""Where a light lies that nobody told, and how far the tissue is: uniform (design.md, issue 19)."""

PRIOR_FOCAL_SD, PRIOR_FALLOFF, PRIOR_SHARPENING = 0.1, (0.0, 4.0), (0.0, 1.2)


@dataclass(frozen=True)
class Told:
    """What reconstruction is told.

    `light`: the lights' places, and the range of the distances in view; `focal`: the focal length; else it is told
    one that is off, and that it is; `vignetting`: the falloff towards the border.
    """

    light: bool = True
    focal: bool = True
    vignetting: bool = True


@dataclass(frozen=True, eq=False)
class Row:
    """A row of the corpus.

    `name`: as in the table; `change`: from a scene's number and tables to what is rendered; `sensor`: from a
    scene's number to the sensor's keys that differ from the plain ones; `told`: what reconstruction is told.
    """

    name: str
    change: Callable[[int, Tables], Tables]
    sensor: Callable[[int], Tables] = field(default=lambda number: {})
    told: Told = Told()


def with_relief(slope_deg: float) -> Callable[[int, Tables], Tables]:
    """Return the change to a slope of the relief."""

    def change(number: int, tables: Tables) -> Tables:
        return tables | {"surface": tables["surface"] | {"relief": relief(number, slope_deg)}}

    return change


def plain(number: int, tables: Tables) -> Tables:
    """Return the scene with its own base relief."""
    return with_relief(base_slope_deg(number))(number, tables)


def vessels(number: int, tables: Tables) -> Tables:
    """Return the scene with the pattern of its tissue; smooth surfaces take the colon's."""
    lobe = {key: value for key, value in tables["reflectance"].items() if key not in ("colour", "diffuse")}
    albedo = {"preset": VESSELS.get(kind_of(number), "colon_mucosa")}
    return plain(number, tables) | {"reflectance": lobe | {"albedo": albedo}}


def moving(shift_px: float) -> Callable[[int, Tables], Tables]:
    """Return the change to a camera that turns, so that the picture moves by so many pixels in the exposure."""

    def change(number: int, tables: Tables) -> Tables:
        angle = float(rng_of(number, "motion").uniform(0, 2 * math.pi))
        speed = math.degrees(shift_px / tables["camera"]["fx"]) / EXPOSURE_S
        turn = [speed * math.cos(angle), speed * math.sin(angle), 0.0]
        motion = {"angular_velocity_deg_s": turn, "exposure_s": EXPOSURE_S, "steps": 8}
        return plain(number, tables) | {"camera": tables["camera"] | {"motion": motion}}

    return change


def wide(number: int, tables: Tables) -> Tables:
    """Return the scene seen through a fisheye of 110 to 130 deg."""
    rng = rng_of(number, "lens")
    focal = tables["camera"]["width"] / math.radians(float(rng.uniform(110, 130)))
    lens = {"type": "kannala_brandt", "k1": float(rng.uniform(-0.03, 0.03))}
    return plain(number, tables) | {"camera": tables["camera"] | {"fx": focal, "fy": focal, "distortion": lens}}


def lit_from(offset_mm: float | None) -> Callable[[int, Tables], Tables]:
    """Return the change to a light so far beside the camera; None: drawn from the prior, and so is the distance."""

    def change(number: int, tables: Tables) -> Tables:
        if offset_mm == 0:
            return plain(number, tables)
        rng = rng_of(number, "light")
        azimuth, drawn = float(rng.uniform(0, 360)), float(rng.uniform(*PRIOR_OFFSET_MM))
        light = {"offset_mm": drawn if offset_mm is None else offset_mm, "azimuth_deg": azimuth}
        return plain(number, tables) | {"rig": {"lights": [light]}}

    return change


def drawn_from_priors(number: int, tables: Tables) -> Tables:
    """Return the scene with light, distance and relief drawn from the priors."""
    rng = rng_of(number, "mixture")
    placed = lit_from(None)(number, at_distance(tables, float(rng.uniform(*PRIOR_DISTANCE_MM))))
    return placed | {"surface": placed["surface"] | {"relief": relief(number, float(rng.uniform(0, 6)))}}


def drawn_sensor(number: int) -> Tables:
    """Return a sensor with sharpening, coding and falloff drawn."""
    rng = rng_of(number, "mixture sensor")
    return PICTURE | {
        "sharpening": {"radius_px": 1.3, "amount": float(rng.uniform(*PRIOR_SHARPENING))},
        "coding": {"type": "jpeg", "quality": int(rng.integers(60, 96))},
        "vignetting": {"type": "cosine", "power": float(rng.uniform(*PRIOR_FALLOFF))},
    }


def _picture(**more: object) -> Callable[[int], Tables]:
    return lambda number: PICTURE | more


def _jpeg(quality: int) -> Callable[[int], Tables]:
    return _picture(coding={"type": "jpeg", "quality": quality})


def _vignetting(number: int) -> Tables:
    power = float(rng_of(number, "vignetting").uniform(*PRIOR_FALLOFF))
    return PICTURE | {"vignetting": {"type": "cosine", "power": power}}


SLOPES_DEG, OFFSETS_MM = (0.0, 0.5, 1.0, 2.0, 4.0), (0.0, 1.0, 3.0, 6.0)


def _rows() -> tuple[Row, ...]:
    rows = [Row(f"relief {s:g} deg", with_relief(s)) for s in SLOPES_DEG]
    rows += [
        Row("vessels", vessels, _picture()),
        *(Row(f"JPEG {quality}", plain, _jpeg(quality)) for quality in (95, 80, 60)),
        Row("mosaic", plain, _picture(mosaic={"pattern": "rggb", "demosaicing": "edge_aware"})),
        Row("sharpening", plain, _picture(sharpening={"radius_px": 1.3, "amount": 0.9})),
        *(Row(f"motion {px:g} px", moving(px), _picture()) for px in (3.0, 7.0)),
        Row("clipping 3 x", plain, lambda n: {"saturation": True, "exposure": {"gain": 3.0}}),
        Row("wide-angle lens", wide),
    ]
    for mm in OFFSETS_MM:
        rows.append(Row(f"light {mm:g} mm, told", lit_from(mm)))
        rows.append(Row(f"light {mm:g} mm, untold", lit_from(mm), told=Told(light=False)))
    rows += [
        Row("light by the prior, untold", lambda n, t: lit_from(None)(n, at_distance(
            t, float(rng_of(n, "distance").uniform(*PRIOR_DISTANCE_MM)))), told=Told(light=False)),
        Row("focal length off", plain, told=Told(focal=False)),
        Row("vignetting untold", plain, _vignetting, Told(vignetting=False)),
        Row("all by the priors", drawn_from_priors, drawn_sensor, Told(False, False, False)),
    ]  # fmt: skip
    return tuple(rows)


ROWS = _rows()

GROUPS = {
    "relief 0 to 4 deg, all told": tuple(row.name for row in ROWS if row.name.startswith("relief")),
    "vessels, camera chain and lens, all told": tuple(
        row.name
        for row in ROWS
        if row.name.startswith(("vessels", "JPEG", "mosaic", "sharpening", "motion", "clipping", "wide"))
    ),
    "light told": tuple(row.name for row in ROWS if row.name.startswith("light") and row.told.light),
    "light untold": tuple(row.name for row in ROWS if row.name.startswith("light") and not row.told.light),
    "all rows": tuple(row.name for row in ROWS),
}
"""Rows whose highlights are counted together."""
