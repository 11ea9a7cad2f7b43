"""The dense track: maps of normals or depths, a pixel each, scored against the truth of a run or a dataset.

`maps` reads maps, says what their values mean, and holds the methods that give them, of which `shading` is a baseline;
`depth` aligns depths, `truth` sorts the pixels of a frame, `score` makes the figures, `page` writes the page.
"""
