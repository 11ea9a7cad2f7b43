"""The figures of the glints themselves, whatever the estimators: theory.md 7.1, 7.2, 7.3, 7.5 and 7.7."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle

import numpy as np
import polars as pl

from simtest.pages.charts import Axis, Bars, Chart, Mark, Panel, finite, log_range
from simtest.pages.style import NEUTRAL, SERIES, number, symbols
from simtest.report.relief_figures import (
    KD,
    LEVEL,
    ReliefFigure,
    larger_kd,
    mean_mark,
    sweep_axis,
    sweep_key,
    sweep_name,
    sweep_position,
    sweeps,
)
from simtest.report.run_folder import Run
from simtest.runtime.statistics import deviation_of_mean, mean_interval, summed
from simtest.validation import laws
from simtest.validation.statistics import units

LEAST_RADIUS_PX = 2.0
"""Below this radius a visible highlight is measured in too few pixels to judge the law."""

_BLUE, _ORANGE = SERIES[:2]
_GLINTS, _VISIBLE = "●", "▲"
_COLUMNS = {
    "cloud", "pool", "radius_px", "radius_law_px", "cloud_glints", "cloud_glints_law", "cloud_visible",
    "cloud_error_deg", "cloud_error_law_deg", "cloud_kd_min", "cloud_kd_max", "cloud_cov_11", "cloud_cov_22",
}  # fmt: skip
_WHOLE = "Only clouds that are wholly in view count, in frames with a detection or an isolated highlight."
_MEANS = "Points are means over the clouds of a setting, bars their 95 % interval (over frames)"


def glint_figures(run: Run) -> list[ReliefFigure]:
    """Compute the figures of clouds and glints; none for runs on smooth surfaces and those of earlier versions."""
    if not {*run.results.columns} >= _COLUMNS:
        return []
    # A row each, whatever the number of estimators and detections.
    clouds = (
        run.results.filter(pl.col("cloud_glints").is_not_null())
        .unique(["setting", "realisation", "cloud"], maintain_order=True)
        .with_columns(larger_kd(run.results, "cloud_kd_min", "cloud_kd_max"))
    )
    spots = run.results.filter(pl.col("pool").is_not_null() & pl.col("true_id").is_not_null()).unique(
        ["setting", "realisation", "true_id"], maintain_order=True
    )
    figures = [_counts(part, x, label) for x, label, part in sweeps(run, clouds)]
    return [*figures, *_centroids(clouds), *_ratios(clouds), *_radii(spots), *_pools(spots)]


def _log(title: str, marks: list[Mark]) -> Axis:
    values = finite([part for mark in marks for part in (mark.y, *((mark.bars or ())[1:2]))])
    return Axis(title, "log", log_range([values]))


# Number (7.2) --------------------------------------------------------------------------------------------------------


def _counts(rows: pl.DataFrame, x: str, label: str) -> ReliefFigure:
    """Describe the numbers of glints and of visible highlights over a swept quantity, with the law."""
    rows = rows.with_columns(at=sweep_position(x))
    marks = []
    for column, name, colour, symbol in (
        ("cloud_glints", "glints", _BLUE, _GLINTS),
        ("cloud_visible", "visible highlights", _ORANGE, _VISIBLE),
    ):
        groups = [(float(at), part) for (at,), part in rows.group_by("at")]
        marks.append(replace(mean_mark(groups, column, colour, name, symbol), line="solid"))
    told = rows.filter(pl.col("cloud_glints_law").is_not_null())
    frames = f"{rows.height} clouds, {rows['cloud_glints'].sum()} glints"
    measured = [f"{number(_ratio(rows, 'cloud_visible', 'cloud_glints'))} visible highlights a glint ({frames})."]
    if not told.is_empty():
        law = told.group_by("at").agg(pl.col("cloud_glints_law").mean()).sort("at")
        dashes = Mark(law["at"].to_numpy(), law["cloud_glints_law"].to_numpy(), NEUTRAL, "law of glints", line="dash",
                      width=1.5, hover="law\n{x}: {y}")  # fmt: skip
        marks.insert(0, dashes)
        ratio, error = _ratio(told, "cloud_glints", "cloud_glints_law"), _ratio_error(told)
        spread = "" if error is None else f" ± {number(error, 2)}"
        measured.insert(0, f"Glints over the law: {number(ratio)}{spread} (standard error).")
    chart = Chart(sweep_key("relief_glints", x, label), f"Glints: number against {sweep_name(x)}, {label}",
                  (Panel(sweep_axis(x), _log("number in a cloud", marks), tuple(marks)),), 400)  # fmt: skip
    about = (
        f"How many glints a cloud holds against {sweep_name(x)}, and how many highlights can be seen in the frame "
        f"without noise (theory, section 7, items 1 and 2). {_WHOLE}"
    )
    caption = f"{_MEANS}; dashes join the law at the settings, E|det(M/d - H)| d²/|det M|."
    if told.is_empty():
        caption = f"{_MEANS}; the law knows no pools."
    return ReliefFigure(chart, about, tuple(measured), caption)


def _ratio(rows: pl.DataFrame, above: str, below: str) -> float | None:
    total = float(rows[below].sum())
    return float(rows[above].sum()) / total if total else None


def _ratio_error(rows: pl.DataFrame) -> float | None:
    """Return the standard error of the glints' number over the law's; None for a single frame."""
    totals, counts, _ = summed(rows["cloud_glints"].to_numpy(), *units(rows), rows["cloud_glints_law"].to_numpy())
    return deviation_of_mean(totals, counts, np.zeros(len(totals), dtype=int)) if len(totals) > 1 else None


# Centroid (7.5) ------------------------------------------------------------------------------------------------------


def _centroids(clouds: pl.DataFrame) -> Iterator[ReliefFigure]:
    """Describe the error of the clouds' mean normals over slope / sqrt(number of glints)."""
    rows = clouds.filter((pl.col("cloud_error_law_deg") > 0) & pl.col("cloud_error_deg").is_not_null())
    if rows["setting"].n_unique() < 2:
        return
    labels = symbols(rows["label"].to_list())
    marks, measured, independent = [], [], float(laws.independent_centroid_error(1.0, 1.0))
    for (name, symbol), colour in zip(labels.items(), cycle(SERIES), strict=False):
        own = rows.filter(pl.col("label") == name).with_columns(
            expected=pl.col("cloud_error_law_deg").mean().over("setting") / independent
        )
        groups = [(float(part["expected"][0]), part) for _, part in own.group_by("setting", maintain_order=True)]
        marks.append(mean_mark(groups, "cloud_error_deg", colour, name, symbol))
        shares = (own["cloud_error_deg"] / own["expected"]).to_numpy()
        low, high = mean_interval(shares, *units(own))
        interval = "" if low is None else f" (95 % interval {number(low)} to {number(high)})"
        measured.append(f"{name}: {number(shares.mean())} s/√N in the mean of {own.height} clouds{interval}.")
    ends = finite([mark.x for mark in marks])
    x = np.geomspace(ends.min() / 1.3, ends.max() * 1.3, 60)
    lines = [Mark(x, laws.independent_centroid_error(x, 1.0), NEUTRAL, "1.25 s/√N: independent glints",
                  line="dot", width=1.5)]  # fmt: skip
    known = " and ".join(f"{factor:g}" for factor in laws.CENTROID_FACTORS)
    lines += [Mark(x, factor * x, NEUTRAL, f"{known} s/√N", line="dash", width=1.5) for factor in laws.CENTROID_FACTORS]
    panel = Panel(Axis("slope over gain and root of the number of glints, s/√N (deg)", "log"),
                  _log("error of the cloud's mean normal (deg)", [*lines, *marks]), (*lines, *marks))  # fmt: skip
    about = (
        "The angle between the base's normal at its own highlight point and the mean of the fine normals of all glints "
        "of the cloud, which with the light at the camera are the reversed sightlines (theory, section 7, item 5). On "
        "a bent base s is the slope divided by the gains 1 + d k, in the mean over directions: so the sightlines "
        f"spread. {_WHOLE}"
    )
    yield ReliefFigure(Chart("relief_centroid", "Clouds: error of the mean normal", (panel,), 440), about,
                       tuple(measured), f"{_MEANS}; dashes are the range of the theory.")  # fmt: skip


# Axis ratio (7.1) ----------------------------------------------------------------------------------------------------


def _ratios(clouds: pl.DataFrame) -> Iterator[ReliefFigure]:
    """Describe the axis ratio of the pooled clouds over the base's curvature, along its principal directions."""
    rows = clouds.filter(pl.col("cloud_glints_law").is_not_null() & pl.col("cloud_cov_11").is_not_null())
    groups = rows.with_columns(at=pl.col(KD).round(2)).group_by("label", "at", maintain_order=True)
    points: dict[str, list[tuple[float, float, float, float]]] = {}
    measured = []
    for (label, at), part in groups:
        ratio, error, interval = pooled_ratio(part)
        points.setdefault(str(label), []).append((float(at), ratio, *interval))
        spread = f" ± {number(error, 2)}" if np.isfinite(error) else ""
        measured.append(
            f"{label}, k d = {at:g}: {number(ratio)}{spread} (law {number(_ratio_law(part))}; "
            f"{part['cloud_glints'].sum()} glints in {part.height} clouds)."
        )
    if sum(len(own) for own in points.values()) < 2:
        return
    shapes, marks = symbols(points), []
    for (name, own), colour in zip(points.items(), cycle(SERIES), strict=False):
        x, y, low, high = np.array(sorted(own)).T
        marks.append(Mark(x, y, colour, name, symbol=shapes[name], bars=Bars(low, high, 1.2),
                          hover=f"{name}\nk d = {{x}}: {{y}}"))  # fmt: skip
    ends = finite([mark.x for mark in marks])
    fine = np.linspace(ends.min(), ends.max(), 161)
    dashes = Mark(fine, [laws.cloud_axis_ratio((1 + kd, 1.0)) for kd in fine], NEUTRAL,
                  "law: |1 + d k|, minor over major", line="dash", width=1.5, hover="law\n{x}: {y}")  # fmt: skip
    panel = Panel(sweep_axis(KD), Axis("axis ratio of the cloud", limits=(0.0, 1.4)), (dashes, *marks))
    about = (
        "The spread of the glints about the base's highlight point in its tangent plane, along the principal direction "
        "of the larger |1 + d k| over that along the smaller one: second moments pooled over all clouds, as those of "
        "a single cloud are too few (theory, section 7, item 1). On a plane the two directions are any two, and the "
        f"ratio may exceed 1. {_WHOLE}"
    )
    caption = "Bars are 95 % intervals (over frames); dashes are the law of a base that is bent in one direction."
    yield ReliefFigure(Chart("relief_axis_ratio", "Clouds: axis ratio against the base's curvature", (panel,), 420),
                       about, tuple(measured), caption)  # fmt: skip


def pooled_ratio(rows: pl.DataFrame) -> tuple[float, float, tuple[float, float]]:
    """Return the axis ratio of pooled clouds, its standard error and 95 % interval; NaN for a single frame.

    A row is a cloud. Second moments are weighted by the number of glints; those of a setting count relative to its
    size, so that the settings need not share slope and distance.
    """
    larger_is_second = (1 + rows["cloud_kd_max"]).abs() >= (1 + rows["cloud_kd_min"]).abs()
    rows = rows.with_columns(
        across=pl.when(larger_is_second).then("cloud_cov_22").otherwise("cloud_cov_11"),
        along=pl.when(larger_is_second).then("cloud_cov_11").otherwise("cloud_cov_22"),
        weight=pl.col("cloud_glints").cast(pl.Float64),
    )
    size = ((pl.col("across") + pl.col("along")) * pl.col("weight")).sum() / pl.col("weight").sum()
    rows = rows.with_columns(weight=pl.col("weight") / size.over("setting"))
    across, along = ((rows["weight"] * rows[name]).to_numpy() for name in ("across", "along"))
    # Of the square, a ratio of sums; settings do not matter to it once they are scaled.
    totals, counts, _ = summed(across, units(rows)[0], None, along)
    ratio = float(np.sqrt(totals.sum() / counts.sum()))
    low, high = mean_interval(totals, counts=counts)
    if low is None or high is None:
        return ratio, np.nan, (np.nan, np.nan)
    deviation = deviation_of_mean(totals, counts, np.zeros(len(totals), dtype=int))
    return ratio, deviation / (2 * ratio), (float(np.sqrt(max(low, 0.0))), float(np.sqrt(high)))


def _ratio_law(rows: pl.DataFrame) -> float:
    gains = [1 + float(rows[name].mean()) for name in ("cloud_kd_min", "cloud_kd_max")]  # type: ignore[arg-type]
    return laws.cloud_axis_ratio((gains[0], gains[1]))


# Size (7.3) ----------------------------------------------------------------------------------------------------------


def _radii(spots: pl.DataFrame) -> Iterator[ReliefFigure]:
    """Describe the measured radii of highlights that hold one glint over those of the law."""
    rows = spots.filter((pl.col("radius_px") > 0) & (pl.col("radius_law_px") > 0))
    if rows.height < 2:
        return
    marks, measured, labels = [], [], symbols(rows["label"].to_list())
    for (name, symbol), colour in zip(labels.items(), cycle(SERIES), strict=False):
        own = rows.filter(pl.col("label") == name)
        law, seen = own["radius_law_px"].to_numpy(), own["radius_px"].to_numpy()
        marks.append(Mark(law, seen, colour, name, symbol=symbol, size=5, opacity=0.7,
                          hover=f"{name}\nlaw {{x}} px, measured {{y}} px"))  # fmt: skip
        ratio = (seen / law)[law >= LEAST_RADIUS_PX]
        if ratio.size:
            low, median, high = np.quantile(ratio, [0.1, 0.5, 0.9])
            measured.append(
                f"{name}: {number(median)} of the law, median of {ratio.size} highlights of {LEAST_RADIUS_PX:g} px "
                f"or more (10 to 90 %: {number(low)} to {number(high)})."
            )
    limits = log_range([rows["radius_law_px"].to_numpy(), rows["radius_px"].to_numpy()])
    line = Mark(limits, limits, NEUTRAL, "law", line="dash", width=1.5)
    panel = Panel(Axis("radius by the law (px)", "log", limits), Axis("radius in the frame (px)", "log", limits),
                  (line, *marks))  # fmt: skip
    about = (
        "The radius of each isolated highlight that is alone in its spot: that of the circle of its area above half "
        "height in the frame without noise, against that of a highlight of the fine surface's curvature at the glint "
        "(theory, section 7, item 3). Relief below a pixel and sources of finite size are not drawn: they widen the "
        "lobe (item 6); python -m studies.unresolved_relief measures by how much a relief does."
    )
    caption = "A point is a highlight; dashes are the law. An area counts whole pixels."
    yield ReliefFigure(Chart("relief_radius", "Glints: radius in the frame against its law", (panel,), 460), about,
                       tuple(measured), caption)  # fmt: skip


# Film (7.7) ----------------------------------------------------------------------------------------------------------


def _pools(spots: pl.DataFrame) -> Iterator[ReliefFigure]:
    """Describe the share and the radii of highlights in pools and on crests over the film's level."""
    if LEVEL not in spots.columns:
        return
    rows = spots.filter(pl.col(LEVEL).is_not_null())
    if rows[LEVEL].n_unique() < 2:
        return
    kinds = (("in pools", True, _BLUE, _GLINTS), ("on crests", False, _ORANGE, _VISIBLE))
    shares, radii, measured = [], [], []
    levels = sorted(rows[LEVEL].unique().to_list())
    for name, pool, colour, symbol in kinds:
        own = rows.filter(pl.col("pool") == pool)
        share = [float((rows.filter(pl.col(LEVEL) == level)["pool"] == pool).mean()) for level in levels]  # type: ignore[arg-type]
        shares.append(Mark(levels, share, colour, name, line="solid", width=0.9, symbol=symbol,
                           hover=f"{name}\nlevel {{x}}: {{y}}"))  # fmt: skip
        alone = own.filter(pl.col("radius_px").is_not_null())
        groups = [(float(level), alone.filter(pl.col(LEVEL) == level)) for level in levels]
        if alone.height:
            radii.append(replace(mean_mark(groups, "radius_px", colour, name, symbol), line="solid"))
        size = f", {number(alone['radius_px'].mean())} px radius in the mean ({alone.height} alone in their spots)"
        measured.append(f"{name}: {own.height} of {rows.height} isolated highlights{size if alone.height else ''}.")
    axis = Axis("level of the film, standard deviations of the height")
    panels = [Panel(axis, Axis("share of highlights", limits=(-0.05, 1.05)), tuple(shares), 0.5)]
    if radii:
        panels.append(Panel(axis, _log("radius (px)", radii), tuple(radii), 0.5))
    about = (
        "Which isolated highlights lie where the film fills a valley, and how large they are, against its level. Pools "
        "are smooth and give the large highlights, crests the small ones (theory, section 7, item 7); most small ones "
        "are not isolated and do not count here."
    )
    caption = "Above: shares. Below: mean radius of those alone in their spot, bars the 95 % interval (over frames)."
    yield ReliefFigure(Chart("relief_pools", "Film: highlights in pools and on crests", tuple(panels), 560), about,
                       tuple(measured), caption)  # fmt: skip
