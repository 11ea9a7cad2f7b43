"""The report of a run: figures as PNG and one self-contained page. Never imports the renderer.

`write` writes the page where it is not up to date (`up_to_date`). `page` puts the sections together; `run_folder`
reads what they are made of. Errors over one quantity are `curves` and `series`, over two `heat_maps`, per surface
`surface_errors`, against laws `error_laws`. `gallery` draws frames, and `scene3d` surfaces.
`paper/` holds the sections of the published protocol, `viewer/` the window of `simtest view`.
"""

from simtest.report.write import write_report

__all__ = ["write_report"]
