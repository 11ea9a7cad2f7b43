"""Camera files of other programs; `files` holds the table of the formats.

Each module states its formats' pixel conventions and axes.
"""
