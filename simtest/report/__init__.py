"""The report of a run: figures as PNG and one self-contained page. Never imports the renderer.

`write` writes the page where it is not up to date. `page` puts the sections together; `run_folder` reads what they are
made of. Errors over one quantity and over two are `error_figures`, on a relief `relief_figures` and `glint_figures`,
against laws `error_laws`, per surface and pair `tables`. `gallery` draws frames, and `scene3d` surfaces.
`paper/` holds the sections of the published protocol, `viewer/` the window of `simtest view`.
"""

from simtest.report.write import write_report

__all__ = ["write_report"]
