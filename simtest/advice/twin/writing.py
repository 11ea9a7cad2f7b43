"""What is written of a picture's twins: twin.json, twin.csv and the page."""

from pathlib import Path

from simtest.advice.twin.matching import Twins
from simtest.advice.twin.page import render_page
from simtest.advice.twin.run import SpotTwins, TwinResult
from simtest.reconstruction.outputs import write_csv
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject, make_folder, write_atomically, write_json

FILES = ("twin.json", "twin.csv", "index.html")

COLUMNS = (
    "specularity", "x_px", "y_px", "radius_px", "estimator", "stated_deg", "twin_rms_deg", "twin_low_deg",
    "twin_high_deg", "twin_p95_deg", "coverage", "near_misses", "false", "glint_rms_deg", "near_rms_deg",
    "base_rms_deg", "base_low_deg", "base_high_deg", "near_mm", "median_mm", "far_mm", "twins", "unlikeness", "covered",
)  # fmt: skip


def write_twins(result: TwinResult, out: Path, command: str = "") -> list[Path]:
    """Write the twins of a picture into a folder, which is made if need be; return the files.

    Raises `InputError` where the folder cannot be written, `SimtestError` where its disk is full.
    """
    make_folder(out)
    html = render_page(result, command)
    write_json(out / FILES[0], to_json(result, command))
    write_atomically(out / FILES[1], lambda part: write_csv(part, COLUMNS, [_row(each) for each in result.spots]))
    write_atomically(out / FILES[2], lambda part: part.write_text(html, encoding="utf-8"))
    return [out / name for name in FILES]


def to_json(result: TwinResult, command: str = "") -> JsonObject:
    """Return the content of twin.json."""
    return {
        "image": result.image,
        "command": command,
        "warnings": result.warnings,
        "assumed": result.assumed,
        "look": {"organ": result.look.organ, "mean_level": result.look.mean},
        "bank": {
            "frames": len(result.bank),
            "highlights": len(result.bank_spots),
            "near_misses": result.share_of("near_miss"),
            "false": result.share_of("false"),
            "processor_s": round(result.processor_s, 1),
        },
        "twin_rms_deg": result.rms_deg(),
        "twin_base_rms_deg": result.rms_deg("base_rms_deg"),
        "coverage": result.coverage,
        "twin_distance_mm": [_finite(each) for each in result.distance_mm],
        "specularities": [_spot_json(each) for each in result.spots],
        "provenance": provenance.environment(),
    }


def _spot_json(each: SpotTwins) -> JsonObject:
    spot, twins = each.spot, each.twins
    return {
        "id": spot.index,
        "peak_px": spot.peak_px,
        "radius_px": spot.radius_px,
        "estimator": spot.estimator,
        "normal": spot.estimate.normal,
        "target": spot.estimate.target,
        "stated_deg": each.stated_deg,
        "twins": twins_json(twins),
    }


def twins_json(twins: Twins) -> JsonObject:
    """Return what the twins of a highlight measure; a figure that they do not have is null."""
    return {
        "rms_deg": twins.rms_deg,
        "interval_deg": twins.interval_deg,
        "p95_deg": twins.p95_deg,
        "coverage": twins.coverage,
        "near_misses": twins.near_misses,
        "false": twins.false,
        "glint_rms_deg": _finite(twins.glint_rms_deg),
        "near_rms_deg": _finite(twins.near_rms_deg),
        "base_rms_deg": twins.base_rms_deg,
        "base_interval_deg": twins.base_interval_deg,
        "distance_mm": [_finite(each) for each in twins.distance_mm],
        "effective": twins.effective,
        "unlikeness": twins.unlikeness,
        "covered": twins.is_covered,
    }


def _finite(value: float) -> float | None:
    # NaN is the only number that differs from itself.
    return value if value == value else None


def _row(each: SpotTwins) -> tuple[object, ...]:
    spot, twins = each.spot, each.twins
    x, y = spot.peak_px.tolist()
    return (
        spot.index, round(x, 3), round(y, 3), spot.radius_px, spot.estimator, each.stated_deg, twins.rms_deg,
        *twins.interval_deg, twins.p95_deg, twins.coverage, twins.near_misses, twins.false,
        _finite(twins.glint_rms_deg), _finite(twins.near_rms_deg), twins.base_rms_deg, *twins.base_interval_deg,
        *(_finite(each) for each in twins.distance_mm), twins.effective, twins.unlikeness, int(twins.is_covered),
    )  # fmt: skip
