"""What the examples share: their options, the angle between two normals, colours, and saving a picture."""

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")  # files only: no example opens a window

import matplotlib.pyplot as plt
import numpy as np

from simtest.pages.style import colours

# The colours that the package's own figures give the estimators; not a public name, so take your own in your scripts.
COLOURS = colours(
    ("circle_pose", "brightest_point", "cone_axis", "curved", "bisector", "photometric", "cloud", "centroid")
)

# Vermilion of true points: it stands out on dark tissue, on a white highlight and on a white ground.
TRUTH = "#D55E00"

plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 100})


def options(doc: str | None, *extra: str) -> argparse.Namespace:
    """Read the command line: ``--out DIR``, ``--quick``, and optional files as positional arguments."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in extra:
        parser.add_argument(name, nargs="?", type=Path)
    default = Path(__file__).resolve().parent / "output"
    parser.add_argument("--out", type=Path, default=default, metavar="DIR", help="folder of the picture")
    parser.add_argument("--quick", action="store_true", help="fewer or smaller frames, for a first look")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    return chosen


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two vectors, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))))


def grey(image: np.ndarray) -> np.ndarray:
    """Return a frame's brightness in [0, 1], to show it."""
    return np.clip(image if image.ndim == 2 else image.mean(axis=2), 0, 1)


def save(figure: plt.Figure, path: Path) -> None:
    """Save a figure as PNG or JPEG and print its path."""
    written = {"quality": 85} if path.suffix == ".jpg" else {"optimize": True}
    figure.savefig(path, bbox_inches="tight", pil_kwargs=written)
    plt.close(figure)
    print(path)
