"""What `simtest calibrate light` writes: calibration.toml, lights.json and a page with every picture."""

from pathlib import Path
from typing import Any

import numpy as np

from simtest.calibration.lights.result import LightCalibration, MeasuredLight
from simtest.pages import pixels, style
from simtest.pages.html import environment
from simtest.reconstruction.light_calibration.run import Calibrated, View
from simtest.reconstruction.overlay import write_text
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, write_atomically, write_json, written_together

PAGE, RESULT, CALIBRATION = "index.html", "lights.json", "calibration.toml"
SHOWN_PX = 360
"""Height of a picture on the page."""

MARGIN = 0.15
"""Room around a ball, as a share of its outline."""

BRIGHT = 0.999
"""Share of the pixels that are darker than the picture's white on the page."""

MEASURED = style.LIGHT
PREDICTED, OUTLINE = (style.ESTIMATOR_COLOURS[name] for name in ("circle_pose", "brightest_point"))


def write_calibration(made: Calibrated, out: Path, command: str = "") -> list[Path]:
    """Write a result into a folder, which is made if need be, and return the files, the page last.

    The calibration is written only if the result has no problem, and an earlier one is taken away.
    """
    from simtest.spec.calibration_file import save_calibration

    make_folder(out)
    with written_together(out, (CALIBRATION, RESULT, PAGE)) as new:
        if not made.result.problems and made.result.own:
            save_calibration(made.calibration, new / CALIBRATION)
        write_json(new / RESULT, {**result_json(made), "run": {"command": command, **provenance.environment()}})
        html = _page(made, command)
        write_atomically(new / PAGE, lambda part: part.write_text(html, encoding="utf-8"))
    return [out / name for name in (CALIBRATION, RESULT, PAGE) if (out / name).exists()]


def result_json(made: Calibrated) -> dict[str, Any]:
    """Return a result as JSON: lengths in mm, camera frame; pixels with centres at integer + 0.5."""
    result, views = made.result, made.views
    pictures, row = [], 0
    for number, view in enumerate(views.views):
        shown = []
        for each in view.highlights:
            told: dict[str, Any] = {"measured_px": each.pixel.round(4).tolist()}
            if each.problem:
                told["left_out"] = each.problem
            else:
                source = int(result.source[row])
                told |= _explained(result, number, source, row)
                row += 1
            shown.append(told)
        pictures.append({"picture": view.name, **made.mirror.view_json(view), "highlights": shown})
    return {
        **made.mirror.to_json(),
        "lights": [_light_json(light) for light in result.lights],
        "residual_rms_px": result.rms_px, "chi2": result.chi2, "degrees_of_freedom": result.freedom,
        "inflation": result.inflation, "notes": list(result.notes), "problems": list(result.problems),
        "pictures": pictures,
        "pictures_left_out": [{"picture": name, "reason": why} for name, why in views.left_out.items()],
    }  # fmt: skip


def _explained(result: LightCalibration, view: int, source: int, row: int) -> dict[str, Any]:
    if source < 0:
        return {"left_out": "no light explains it: a second reflection, a window or a lamp"}
    return {
        "light": source + 1,
        "predicted_px": result.predicted_px[view, source].round(4).tolist(),
        "residual_px": result.residuals_px[row].round(4).tolist(),
    }


def _light_json(light: MeasuredLight) -> dict[str, Any]:
    half = light.half_widths_mm
    return {
        "position_mm": light.position_mm.round(5).tolist(),
        "interval95_mm": np.stack([light.position_mm - half, light.position_mm + half], axis=1).round(5).tolist(),
        "covariance_mm2": light.covariance_mm2.tolist(),
        "pictures": light.pictures,
        "on_the_tip": not light.is_foreign,
    }


def _page(made: Calibrated, command: str) -> str:
    result = made.result
    drawn, row = [], 0
    for number, view in enumerate(made.views.views):
        rows = range(row, row := row + len(view.usable))
        sizes = (float(np.linalg.norm(result.residuals_px[i])) for i in rows if result.source[i] >= 0)
        drawn.append((view, _drawn(made, view, number, rows), max(sizes, default=None)))
    about = provenance.environment()
    return environment().get_template("light.html.j2").render(
        result=result, made=made, command=command, drawn=drawn,
        lights=list(enumerate(result.lights, 1)),
        colours={"measured centre": MEASURED, "predicted centre": PREDICTED, "outline of the ball": OUTLINE},
        provenance={"commit": about["commit"] or "–", "simtest": about["version"], "python": about["python"]},
    )  # fmt: skip


def _drawn(made: Calibrated, view: View, number: int, rows: range) -> str:
    """Return a picture with outline, measured and predicted highlights, as an address."""
    camera, result = made.calibration.camera, made.result
    border = None if view.outline is None else view.outline.pixels(camera, 180)
    window = (0.0, float(camera.width), 0.0, float(camera.height))
    if border is not None:
        room = MARGIN * float(np.ptp(border, axis=0).max())
        low = np.maximum(border.min(axis=0) - room, 0)
        high = np.minimum(border.max(axis=0) + room, [camera.width, camera.height])
        window = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    part = view.intensity[int(window[2]) : int(np.ceil(window[3])), int(window[0]) : int(np.ceil(window[1]))]
    white = max(float(np.quantile(part, BRIGHT)), 1e-9)
    canvas = pixels.Canvas((view.intensity / white).astype(np.float32), window, SHOWN_PX)
    if border is not None:
        canvas.line(border, OUTLINE, 1, dashed=True)
    for each in view.highlights:
        canvas.cross(each.pixel, MEASURED, "#000000", 14, tilted=True)
    for row in rows:
        if (source := int(result.source[row])) >= 0:
            point = result.predicted_px[number, source]
            canvas.ring(point, PREDICTED, 10)
            at = ((point - canvas.corner) * canvas.scale).round().astype(int)
            write_text(canvas.pixels, str(source + 1), (int(at[0]) + 12, int(at[1]) - 8), (255, 255, 255), 0.5)
    return pixels.data_address(canvas.pixels)
