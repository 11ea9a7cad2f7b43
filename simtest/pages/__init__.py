"""The parts that every page is made of; this room knows nothing of runs, frames or cameras.

`charts` turns records of figures into Vega-Lite specifications, which Vega draws in pages and vl-convert in files.
`pixels` draws on enlarged frames. `style` holds colours, symbols and number formats, `html` the templates.
"""

WRITTEN = "page written"
"""Text of the last step of writing a page: nothing follows it."""
