"""The published validation protocol [MB, section 3.1]: a plane's texture seen slanted by a camera that is not at V.

It tests the conic pipeline, not the imaging of a camera with its own light; the rendered experiments do that.
`protocol` makes the noise-free picture, adds noise, smooths and reconstructs; `rows` measures.
`predictions` are of the error without noise, and of the least error with it.
"""
