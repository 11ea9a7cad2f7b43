"""The parts that every page is made of; this room knows nothing of runs, frames or cameras.

`chart` describes a figure once; `axes` chooses its ranges and ticks; `chart_web` draws it in a page (plotly's JSON) and
`chart_png` in a file, on a `sheet` (OpenCV and Pillow). `pixels` draws on enlarged frames. `style` holds colours,
symbols and number formats, `html` the templates; `vendor/` holds plotly's bundle.
"""

WRITTEN = "page written"
"""Text of the last step of writing a page: nothing follows it."""
