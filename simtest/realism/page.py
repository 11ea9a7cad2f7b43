"""Writes a comparison: realism.json, figures as PNG, and one HTML file that needs nothing else."""

from pathlib import Path

from simtest.pages import WRITTEN, pixels
from simtest.pages.charts import Chart, embedded, png
from simtest.pages.html import environment
from simtest.realism import charts
from simtest.realism.comparison import Comparison, Progress, SetOfFrames, plain
from simtest.realism.distance import LEAST_SCENES, NEAR, distance_text
from simtest.realism.frame_statistics import STATISTICS
from simtest.realism.strip import draw_strip
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, write_atomically, write_json

PAGE, RESULT = "index.html", "realism.json"

STRIP_HEIGHT_PX = 200
_STEPS = ("the strip of frames", "the distances", "the distributions", "the page")


def write_comparison(
    found: Comparison, out: Path, against: str, command: str = "", progress: Progress | None = None
) -> Path:
    """Write a comparison into a folder, which is made if need be.

    Parameters
    ----------
    found : Comparison
        What to write.
    out : Path
        Gets realism.json, index.html, and figures/{strip,distances,distributions}.png. Pictures of real frames stand
        in the page and in the strip, nowhere else.
    against, command : str
        The generated side as it was named, and how the comparison was called.
    progress : callable, optional
        Called with steps done, steps in all, and what is done; what it raises stops the writing between two files.

    Returns
    -------
    Path
        The page.
    """

    def tell(step: int) -> None:
        if progress:
            progress(step, len(_STEPS), f"drawing {_STEPS[step]}")

    make_folder(out / "figures")
    tell(0)
    rows = [("real", found.real.pictures), ("generated", found.generated.pictures)]
    strip = draw_strip([row for row in rows if row[1]], STRIP_HEIGHT_PX)
    _write_png(out / "figures" / "strip.png", pixels.png(strip))
    tell(1)
    distance, columns = charts.distance_chart(found), charts.distribution_charts(found)
    _write_png(out / "figures" / "distances.png", png([distance]))
    tell(2)
    _write_png(out / "figures" / "distributions.png", png(columns))
    tell(3)
    html = _render(found, against, command, distance, columns)
    # These come last, so that a stopped command leaves the earlier ones.
    record = {"against": against, "command": command, **provenance.environment()}
    write_json(out / RESULT, {**found.to_json(), "run": record})
    write_atomically(out / PAGE, lambda part: part.write_text(html, encoding="utf-8"))
    if progress:
        progress(len(_STEPS), len(_STEPS), WRITTEN)
    return out / PAGE


def _write_png(path: Path, content: bytes) -> None:
    write_atomically(path, lambda part: part.write_bytes(content))


def _render(found: Comparison, against: str, command: str, distance: Chart, columns: list[Chart]) -> str:
    """Fill in the page's template."""
    made_by = provenance.environment()
    groups, at = [], 0
    for statistic in STATISTICS:
        groups.append((statistic, columns[at : at + len(statistic.columns)]))
        at += len(statistic.columns)
    sides = (("real", found.real), ("generated", found.generated))
    return environment().get_template("realism.html.j2").render(
        found=found, title=Path(against).stem or against, command=command, distance=distance, groups=groups,
        sides=[(name, _counted(held)) for name, held in sides],
        strips=[(name, [(title, pixels.data_address(picture)) for title, picture in held.pictures])
                for name, held in sides],
        colours={"real": charts.REAL, "generated": charts.GENERATED},
        verdicts={word: (symbol, charts.VERDICT_COLOURS[word]) for word, symbol in charts.VERDICT_SYMBOLS.items()},
        text=distance_text, finite=plain, near=NEAR, least=LEAST_SCENES,
        provenance={"commit": made_by["commit"] or "–", "simtest": made_by["version"],
                    "python": made_by["python"]},
        **embedded([distance, *columns]),
    )  # fmt: skip


def _counted(held: SetOfFrames) -> str:
    """Return how many scenes and frames a side has, in words."""
    scenes, frames = len(held.scenes), held.frames
    text = f"{scenes} {'scene' if scenes == 1 else 'scenes'}, {frames} {'frame' if frames == 1 else 'frames'}"
    return text + (f", {held.without_highlights} without a highlight" if held.without_highlights else "")
