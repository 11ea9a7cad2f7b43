"""The page of a scene in 3D, to turn and zoom: one file that needs nothing else."""

from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.pages.charts import packed
from simtest.pages.html import environment
from simtest.pages.palette import colours
from simtest.report.scene3d import TRUE, TRUE_BASE, Content, estimators, framed
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.files import write_atomically


def check_page(path: Path) -> None:
    """Raise `InputError` where it is plain, before anything is rendered, that there can be no page."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--page {path}: suffix {path.suffix!r}; must be .html")


def write_scene_page(content: Content, path: Path, title: str) -> None:
    """Write the page of a scene; raises `InputError` if the file cannot be written."""
    check_page(path)
    frame, parts = framed(content, "lit")
    html = environment().get_template("scene.html.j2").render(
        title=title, errors=errors_deg(content), frame=packed(frame), parts=parts, colours=colours(estimators(content)),
        highlights=int((content.names == TRUE).sum()), rough=bool((content.names == TRUE_BASE).any()),
        compared=compared_with(content),
    )  # fmt: skip
    write_atomically(path, lambda part: part.write_text(html, encoding="utf-8"))


def errors_deg(content: Content) -> dict[str, list[float]]:
    """Return the angles of each estimator's normals to the nearest true one, deg; none where nothing is true.

    True normals are those of the fine surface, or else those of the base (`compared_with`).
    """
    is_true = content.names == compared_with(content)
    if not is_true.any():
        return {name: [] for name in estimators(content)}
    made: dict[str, list[float]] = {}
    for name in estimators(content):
        own = content.names == name
        starts = content.starts[own]
        nearest = np.linalg.norm(starts[:, None] - content.starts[is_true][None], axis=2).argmin(axis=1)
        cosine = (_directions(content, own) * _directions(content, is_true)[nearest]).sum(axis=1)
        made[name] = np.degrees(np.arccos(np.clip(cosine, -1, 1))).tolist()
    return made


def compared_with(content: Content) -> str:
    """Return the name of the true normals that the estimates are compared with."""
    return TRUE if (content.names == TRUE).any() else TRUE_BASE


def _directions(content: Content, own: Mask) -> Array:
    along = content.ends[own] - content.starts[own]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))
