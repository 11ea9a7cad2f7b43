"""Writes the page of a run, where it is not up to date."""

from collections.abc import Callable
from pathlib import Path

from simtest.pages import WRITTEN
from simtest.report.up_to_date import GUIDE, is_up_to_date, page_key, signed
from simtest.runtime.files import write_atomically, write_json
from simtest.runtime.provenance import file_hash

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and what is done."""


def write_report(run: Path, progress: Progress | None = None, charts: bool = False) -> Path:
    """Write the page of a run and the pictures of its frames; what is up to date stays as it is.

    Parameters
    ----------
    run : pathlib.Path
        Run folder with results.parquet, summary.json and, if there is one, gallery/*.npz.
    progress : callable, optional
        Called with steps done, steps in all (a figure or frame each, and the page), and what is done; what it raises
        stops the report, and the page stays the earlier one.
    charts : bool
        Whether the charts, which the page draws, are written as PNG files too.

    Returns
    -------
    pathlib.Path
        ``run/index.html``. Beside it, ``run/guide.json`` and ``run/figures/*.png`` are written anew; pictures of an
        earlier report go.
    """
    run = Path(run)
    page, key = run / "index.html", page_key(run)
    if is_up_to_date(run, key, charts):
        return page
    # Imported here: a page that is up to date needs none of what draws it.
    from simtest.report.page import draw_page, guide_json
    from simtest.report.run_folder import read_run

    if progress:
        progress(0, 1, "reading the results")
    data = read_run(run)
    folder = run / "figures"
    folder.mkdir(exist_ok=True)
    html, figures, steps = draw_page(data, folder, progress, charts)
    write_json(run / GUIDE, guide_json(data))
    # The page comes last, so that a stopped report leaves the earlier one.
    note = signed(html, key, charts, figures, file_hash(run / GUIDE))
    write_atomically(page, lambda part: part.write_text(note, encoding="utf-8"))
    if progress:
        progress(steps, steps, WRITTEN)
    return page
