"""Print a table of the manual from a run: `python -m studies.run_tables NAME FOLDER`, with the names of `TABLES`.

FOLDER is what `simtest validate NAME --out FOLDER` wrote; the page that holds the table names the command.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import polars as pl

from benchmarks.measuring import print_markdown
from simtest.report.error_laws import law_results
from simtest.report.run_folder import Run, read_run

Rows = Iterator[Sequence[str]]

OK = pl.col("status") == "ok"

_GAIN = "sensor.exposure.gain"


def curvature(run: Run) -> Rows:
    """Yield docs/measured/curvature.md: a row for each setting."""
    results = run.results
    yield ["surface", "d k", "axis ratio: law (3.2)", "axis ratio: measured", "circle pose: law (4.1), deg",
           "circle pose, better candidate, deg", "brightest point, deg", "cone axis, deg"]  # fmt: skip
    for _, rows in results.group_by("setting", maintain_order=True):
        by = {name: _of(rows, name) for name in ("circle_pose", "brightest_point", "cone_axis")}
        low, high = float(rows["kd_min"].mean()), float(rows["kd_max"].mean())
        yield [
            rows["label"][0],
            f"{low:.2f}, {high:.2f}" if low * high < -1e-6 else f"{high if abs(high) >= abs(low) else low:.2f}",
            _number(rows["axis_ratio_law"].mean(), 3),
            _answer(by["cone_axis"], "axis_ratio", 3),
            _number(by["circle_pose"]["error_law_deg"].mean(), 1),
            _answer(by["circle_pose"], "error_oracle_deg", 1),
            _answer(by["brightest_point"], "error_deg", 2),
            _answer(by["cone_axis"], "error_deg", 4),
        ]


def sensor(run: Run) -> Rows:
    """Yield docs/measured/sensor.md: means of cone_axis, a row for each sweep."""
    results = run.results
    yield ["sweep", "plane", "cylinder"]
    answered = _of(results.filter(OK), "cone_axis")
    gains = [0.9, 1.5, 2, 4]
    by_gain = [answered.filter((pl.col("label") == "plane, clipped") & (pl.col(_GAIN) == gain)) for gain in gains]
    clipped = ", ".join(_number(100 * rows["saturated_share"].mean(), 0) for rows in by_gain)
    sweeps = {
        "white noise 1, 2, 5, 8 %": ("", "sensor.noise_sigma", [0.01, 0.02, 0.05, 0.08]),
        "full well of 250, 1000, 8000 electrons, 10 of read noise":
            (", shot noise", "sensor.full_well", [250, 1000, 8000]),
        f"exposure 0.9, 1.5, 2, 4 times ({clipped} % of the isophote at t = 0.5 clipped), noise 2 %":
            (", clipped", _GAIN, gains),
        "point spread 0, 1, 2, 3 px, noise 2 %": (", blurred", "sensor.point_spread_px", [0, 1, 2, 3]),
    }  # fmt: skip
    for sweep, (end, key, values) in sweeps.items():
        of = [answered.filter(pl.col("label") == surface + end) for surface in ("plane", "cylinder")]
        yield [sweep, *(", ".join(_number(rows.filter(pl.col(key) == v)["error_deg"].mean(), 3) for v in values)
                        for rows in of)]  # fmt: skip
    coded = answered.filter(pl.col("sensor.bits").is_not_null())["error_deg"].max()
    yield ["8 to 16 bits, without noise: linear; gamma 2.2 known or unknown", "", f"at most {_number(coded, 4)}"]


def rig(run: Run) -> Rows:
    """Yield docs/measured/rig.md: medians, a row for each surface and rig."""
    results = run.results
    yield ["surface", "rig", "true highlights", "found", "law, deg", "brightest_point, deg", "cone_axis, deg"]
    true = results.filter(pl.col("true_id").is_not_null())
    for (label, setting), rows in true.group_by("label", "setting", maintain_order=True):
        axis, peak = _of(rows, "cone_axis"), _of(rows, "brightest_point").filter(OK)
        answered = axis.filter(OK)
        # The run gives the law of a single light, which may be nearer to the surface than the camera, or farther.
        half = answered.select(pl.coalesce("error_law_deg", pl.col("eps_over_d").arctan().degrees() / 2)).to_series()
        yield [
            str(label), str(setting).partition("preset=")[2], str(axis.height), str(answered.height),
            _number(half.median(), 2), _number(peak["error_deg"].median(), 2),
            _number(answered["error_deg"].median(), 3),
        ]  # fmt: skip


def interreflection(run: Run) -> Rows:
    """Yield docs/measured/sensor.md: medians of cone_axis."""
    results = run.results
    yield ["radius, mm", "albedo", "direct", "bounces"]
    keys = "surface.radius_mm", "reflectance.diffuse"
    for at, rows in _of(results, "cone_axis").filter(OK).group_by(*keys, maintain_order=True):
        depths = sorted(rows["render.path_depth"].unique())
        medians = [rows.filter(pl.col("render.path_depth") == depth)["error_deg"].median() for depth in depths]
        yield [*(f"{value:g}" for value in at), *(_number(median, 3) for median in medians)]


def camera(run: Run) -> Rows:
    """Yield docs/measured/sensor.md: means of cone_axis, and in brackets of circle_pose."""
    results = run.results
    angles = [0.5, 10.0, 20.0, 40.0, 60.0]
    yield ["lens", *(f"{angle:g} deg" for angle in angles)]
    for (label, k1), rows in results.filter(OK).group_by("label", "camera.distortion.k1", maintain_order=True):
        if k1 == 0:
            continue
        at = [rows.filter(pl.col("surface.tilt_deg") == angle) for angle in angles]
        pairs = [(_of(part, "cone_axis")["error_deg"].mean(), _of(part, "circle_pose")["error_deg"].mean())
                 for part in at]  # fmt: skip
        lens = str(label) if k1 is None else f"plane, k1 = {k1:g}"
        yield [lens, *("" if axis is None else f"{axis:.3f} ({circle:.1f})" for axis, circle in pairs)]


def known_light(run: Run) -> Rows:
    """Yield docs/measured/light_offset.md: mean errors of bisector."""
    results = run.results
    yield ["distance given", "cone_axis", "bisector"]
    for (setting,), rows in results.filter(OK).group_by("setting", maintain_order=True):
        means = (_of(rows, name)["error_deg"].mean() for name in ("cone_axis", "bisector"))
        yield [str(setting), *(_number(mean, 3) for mean in means)]


def relief(run: Run) -> Rows:
    """Yield docs/measured/relief.md: mean errors, a row for each sweep."""
    results = run.results
    yield ["sweep", "highlights", "cone_axis", "brightest_point", "circle_pose (answers)", "cone_axis over the law"]
    answered = results.filter(OK & pl.col("true_id").is_not_null())
    sweeps = {
        "slope 1 to 8 deg": "surface.relief.bands.0.slope_deg",
        "wavelength 1 to 4 mm": "surface.relief.bands.0.wavelength_mm",
        "distance 10 to 30 mm": "surface.distance_mm",
        "k d of the base -0.5 to 2": "surface.radius_mm",
        "level of the film -2 to 1": "reflectance.film.level",
    }
    for sweep, key in sweeps.items():
        rows = answered.filter(pl.col(key).is_not_null())
        axis, peak, circle = (_of(rows, name) for name in ("cone_axis", "brightest_point", "circle_pose"))
        base, law = axis["error_base_deg"].mean(), axis["error_base_law_deg"].mean()
        over = f"no law with pools; {base:.1f} deg" if law is None else f"{base / law:.2f}"
        means = (_number(each["error_fine_deg"].mean(), 3) for each in (axis, peak))
        yield [sweep, str(axis.height), *means, f"{circle['error_fine_deg'].mean():.0f} ({circle.height})", over]


def reflectance(run: Run) -> Rows:
    """Yield docs/measured/reflectance.md: answers and errors of each estimator."""
    results = run.results
    yield ["estimator", "answers", "why none", "error, deg: median (largest) of how many"]
    for name in ("cone_axis", "brightest_point", "circle_pose"):
        rows = _of(results.filter(pl.col("true_id").is_not_null()), name)
        ok, failed = rows.filter(OK), rows.filter(~OK)["status"].value_counts()
        arcs = pl.col("flags").str.contains("partial_arc")
        parts = {
            "cone_axis": {"": ok.filter(~arcs), "with the flag `partial_arc` ": ok.filter(arcs)},
            "brightest_point": {"": ok},
            "circle_pose": {f"{on} ": ok.filter(pl.col("label").str.starts_with(on)) for on in ("plane", "cylinder")},
        }[name]
        digits = 1 if name == "circle_pose" else 3
        errors = {head: part["error_oracle_deg"] for head, part in parts.items()}
        shown = (f"{head}{_number(error.median(), digits)} ({_number(error.max(), digits)}) of {len(error)}"
                 for head, error in errors.items())  # fmt: skip
        reasons = (f"{count} {status}" for status, count in failed.sort("count", "status", descending=True).iter_rows())
        yield [name, f"{ok.height} of {rows.height}", ", ".join(reasons), ", ".join(shown)]


def laws(run: Run) -> Rows:
    """Yield docs/measured/laws.md."""
    yield ["law", "settings met", "predicted", "largest departure, as a share of the law", "where"]
    for result in law_results(run):
        yield [result.law.title, *(result.cells[key] for key in ("met", "range", "share", "where"))]


def compare(run: Run) -> Rows:
    """Yield docs/measured/compare.md: means, a row for each surface."""
    normals = ("cone_axis", "bisector", "photometric", "inverse_rendering")
    curvatures = ("curved", "inverse_rendering")
    heads = [*normals, *(f"gains: {name}" for name in curvatures), f"direction: {', '.join(curvatures)}"]
    yield ["surface", *heads]
    surfaces = {
        "plane": "plane, tilted by 0.5 and 15 deg",
        "cylinder outside": "cylinder outside, d k = 0.1, 1, 3",
        "cylinder inside": "cylinder inside, d k = -1/3, -1/2, -2/3",
        "saddle": "saddle, d k = (0.3, -0.3), (1, -0.5)",
        "light beside the camera": "cylinder outside, light 1 mm beside the camera",
        "base under the lobe": "cylinder outside, a diffuse base of half the lobe's strength",
    }
    for label, surface in surfaces.items():
        rows = run.results.filter(OK & (pl.col("label") == label))
        errors = [_of(rows, name)["error_deg"].mean() for name in normals]
        gains = [100 * _of(rows, name)["gain_error"].mean() for name in curvatures]
        directions = [_number(_of(rows, name)["direction_error_deg"].mean(), 2) for name in curvatures]
        cells = [*(_number(error, 3 if error < 1 else 2) for error in errors), *(f"{gain:.1f} %" for gain in gains)]
        yield [surface, *cells, ", ".join(filter(None, directions))]


def motion(run: Run) -> Rows:
    """Yield docs/measured/motion.md: shares of the signs that are given."""
    lengths = [0.2, 0.5, 1.0, 2.0, 5.0]
    yield ["surface, d k", *(f"{length:g} mm" for length in lengths)]
    surfaces = {
        "sphere outside": "sphere from outside, 1 and 1",
        "sphere inside": "sphere from inside, -0.5 and -0.5",
        "concave beyond its centre": "concave beyond its centre, -2.4 and -2.7",
        "saddle": "saddle, 0.5 and -0.5",
        "saddle beyond its centre": "saddle beyond its centre, 0.6 and -3.2",
        "cylinder, across its axis": "cylinder, moved across its axis: one of two signs",
        "cylinder, along its axis": "cylinder, moved along its axis: one of two signs",
        "colon": "colon, distance known to 30 %",
        "colon with relief": "colon with a relief of 2 deg, wavelength 4 mm",
        "liver": "liver, 40 to 150 mm away",
    }
    rows = _of(run.results, "motion").filter(pl.col("true_id").is_not_null())
    # A sign of 0 is left open.
    signs = [pl.col(f"motion_sign_{i}").fill_null(0) for i in (1, 2)]
    given = sum(((sign != 0).cast(pl.Int64) for sign in signs), pl.lit(0))
    for label, surface in surfaces.items():
        of = [rows.filter((pl.col("label") == label) & (pl.col("views.length_mm") == length)) for length in lengths]
        shares = (None if part.is_empty() else 50 * part.select(given.mean()).item() for part in of)
        yield [surface, *(_number(share, 0) for share in shares)]
    wrong = sum(rows.filter(sign * pl.col(f"motion_gain_{i}") < 0).height for i, sign in enumerate(signs, 1))
    total = rows.select(given.sum()).item()
    yield [f"{total} signs of {2 * rows.height} are given, {wrong} of them are wrong", *[""] * len(lengths)]


def paper(run: Run) -> Rows:
    """Yield docs/measured/published.md: errors of the better candidate and the Cramer-Rao bound, a row each setting."""
    yield ["setting", "answered", "mean, deg", "largest, deg", "Cramer-Rao bound, deg"]
    for (setting,), rows in run.results.group_by("setting", maintain_order=True):
        error, bound = rows.filter(OK)["error_oracle_deg"], rows["bound_deg"].mean()
        figures = _number(error.mean(), 2), _number(error.max(), 2), _number(bound, 3)
        yield [str(setting), f"{len(error)} of {rows.height}", *figures]


TABLES: dict[str, Callable[[Run], Rows]] = {
    table.__name__: table
    for table in (
        curvature,
        sensor,
        rig,
        interreflection,
        camera,
        known_light,
        relief,
        reflectance,
        laws,
        compare,
        motion,
        paper,
    )
}


def _of(rows: pl.DataFrame, estimator: str) -> pl.DataFrame:
    return rows.filter(pl.col("estimator") == estimator)


def _number(value: object, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _answer(rows: pl.DataFrame, column: str, digits: int) -> str:
    """Return the mean of the rows that answered, or why none did."""
    mean = rows.filter(OK)[column].mean()
    return _number(mean, digits) if mean is not None else str(rows["status"][0])


if __name__ == "__main__":
    print_markdown(list(TABLES[sys.argv[1]](read_run(Path(sys.argv[2])))))
