"""Mistakes that a whole table of answers gives away: pixels, axes or units other than simtest's."""

from collections.abc import Mapping

import numpy as np
import polars as pl

from simtest.dataset.scoring.record import Record
from simtest.dataset.scoring.table import Answers
from simtest.runtime.arrays import Array

LEAST_ROWS = 5
"""Rows that a doubt about all of them needs."""

STRAY_SHARE = 0.5
"""Of the rows: so many outside every detection are more than a detector's differences."""

CLEARLY = 0.5
"""A reversal is told where it leaves less than this share of the median error ..."""

LEAST_GAIN_DEG = 1.0
"""... and takes away more than this."""

FAR_TOO_WIDE = 20.0
"""A standard deviation so many times the error is doubted; one in degrees is 57 times too large ..."""

LEAST_WIDE_DEG = 5.0
"""... and one below this is not, since a method may state the resolution of its frames."""

REVERSALS: Mapping[str, tuple[int, int]] = {"x": (-1, 1), "y": (1, -1), "x and y": (-1, -1)}
"""Signs of normal_x and normal_y. With z reversed a normal faces away, which is refused row by row."""


def stray_rows(answers: Answers, record: Record) -> str | None:
    """Return a warning where most rows lie in no region of a detection, as region-relative pixels do."""
    inside: list[bool] = []
    for by_frame in answers.values():
        for frame, rows in by_frame.items():
            boxes = np.array(record.frames[frame].boxes, dtype=float).reshape(-1, 4)
            located = [answer.point_px for answer in rows if answer.specularity is None]
            inside += [_is_in_any(point, boxes) for point in located]
    stray = inside.count(False)
    if stray < LEAST_ROWS or stray <= STRAY_SHARE * len(inside):
        return None
    return (
        f"{stray} of {len(inside)} rows lie in no detection's region (highlights.csv); x_px, x to the right, and y_px, "
        "down, count from the frame's upper left corner"
    )


def reversed_axes(results: pl.DataFrame) -> list[str]:
    """Return a warning for each method whose normals are right with an axis reversed."""
    rows = results.filter(pl.col("status") == "ok").drop_nulls(["normal_x", "truth_x"])
    found = []
    for (name,), own in rows.group_by("estimator", maintain_order=True):
        if own.height < LEAST_ROWS:
            continue
        normals = own.select("normal_x", "normal_y", "normal_z").to_numpy()
        truths = own.select("truth_x", "truth_y", "truth_z").to_numpy()
        as_given = _median_deg(normals, truths)
        errors = {axis: _median_deg(normals * [*signs, 1], truths) for axis, signs in REVERSALS.items()}
        axis = min(errors, key=lambda each: errors[each])
        if errors[axis] < CLEARLY * as_given and as_given - errors[axis] > LEAST_GAIN_DEG:
            found.append(
                f"{name}: with {axis} of the normals reversed the median error is {errors[axis]:.3g} deg, not "
                f"{as_given:.3g}; axes must be x to the right, y down, z forward"
            )
    return found


def wide_regions(results: pl.DataFrame) -> list[str]:
    """Return a warning for each method that states a far greater uncertainty than its errors have, as deg^2 do."""
    rows = results.filter(pl.col("status") == "ok").drop_nulls(["cov_11", "cov_22", "error_deg"])
    found = []
    for (name,), own in rows.group_by("estimator", maintain_order=True):
        stated = np.degrees(np.sqrt((own["cov_11"].to_numpy() + own["cov_22"].to_numpy()) / 2))
        errors = own["error_deg"].to_numpy()
        if own.height < LEAST_ROWS or np.median(stated) < LEAST_WIDE_DEG:
            continue
        if np.median(errors / stated) < 1 / FAR_TOO_WIDE:
            found.append(
                f"{name}: the covariances state a standard deviation of {np.median(stated):.3g} deg in the median, and "
                f"the median error is {np.median(errors):.3g} deg; must be in rad^2 (1 deg^2 is 0.000305 rad^2)"
            )
    return found


def _is_in_any(point: Array, boxes: Array) -> bool:
    low, size = boxes[:, :2], boxes[:, 2:]
    return bool(((point >= low) & (point <= low + size)).all(axis=1).any())


def _median_deg(normals: Array, truths: Array) -> float:
    across = np.linalg.norm(np.cross(normals, truths), axis=1)
    return float(np.degrees(np.median(np.arctan2(across, (normals * truths).sum(axis=1)))))
