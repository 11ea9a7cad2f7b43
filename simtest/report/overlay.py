"""The picture with its isophotes, ellipses and normals: overlay.png of `simtest reconstruct`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.geometry import Camera
from simtest.report import static
from simtest.report.style import colours

ARROW_SHARE = 0.12
"""Length of a drawn normal over the picture's larger side, for a normal across the view."""


def draw_overlay(path: Path, picture: npt.NDArray[np.float32], camera: Camera, spots: Sequence[dict[str, Any]]) -> None:
    """Draw a picture with what was reconstructed in it.

    Parameters
    ----------
    path : Path
        The PNG.
    picture : ndarray of float32, shape (H, W) or (H, W, 3)
        In [0, 1], as encoded.
    camera : Camera
        Calibration.
    spots : sequence of dict
        Specularities as in normals.json.
    """
    import matplotlib.pyplot as plt

    height, width = picture.shape[:2]
    palette = colours(name for spot in spots for name in spot["estimates"])
    with static.settings():
        figure, ax = plt.subplots(figsize=(9, 9 * height / width + 0.8), layout="constrained")
        ax.imshow(picture, cmap="gray", vmin=0, vmax=1, extent=(0, width, height, 0), interpolation="nearest")
        ax.grid(False)
        for spot in spots:
            for name, result in spot["estimates"].items():
                if result["status"] == "ok":
                    _draw_result(ax, result, palette[name], ARROW_SHARE * max(width, height))
            x, y, w, _ = spot["box_px"]
            ax.annotate(str(spot["id"]), (x + w, y), color="yellow", fontsize=9, ha="left", va="top")
        for name, colour in palette.items():
            ax.plot([], [], color=colour, label=name)
        ax.set(xlim=(0, width), ylim=(height, 0), xlabel="x (px)", ylabel="y (px)")
        ax.set_title(f"{len(spots)} specularities: ellipses, and normals projected along the view")
        if palette:
            figure.legend(loc="outside lower center", ncols=len(palette))
        figure.savefig(path, dpi=130)
        plt.close(figure)


def _draw_result(ax: Any, result: dict[str, Any], colour: str, reach: float) -> None:
    """Draw the ellipses of one estimate, and each candidate normal by its part across the view."""
    for curve in result["curves"]:
        ax.plot(*np.array(curve).reshape(-1, 2).T, color=colour, lw=0.8)
    if None in result["look_px"]:
        return
    x, y = result["look_px"]
    for i, normal in enumerate(result["candidates"]):
        dx, dy = reach * normal[0], reach * normal[1]
        style = {"arrowstyle": "->", "color": colour, "lw": 1.6 if i == 0 else 0.9}
        ax.annotate("", (x + dx, y + dy), (x, y), arrowprops=style)
    ax.plot(x, y, ".", color=colour, ms=4)
