"""How Sphinx builds the manual: `make docs` writes it to build/manual, with warnings as errors."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs/_ext")]

project = "simtest"
html_title = "simtest"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "generated_pages",
    "repository_links",
]
exclude_patterns = ["_ext", "_static"]
# A word in single backquotes is code in docstrings, as it is in the pages.
default_role = "code"
# Anchors like GitHub's, so that links work on both.
myst_heading_anchors = 5
myst_enable_extensions = ["dollarmath"]
highlight_language = "none"
# Two hyphens are an option of a command.
smartquotes = False

toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_js_files = ["manual.js"]
html_show_sphinx = False
html_use_index = False
html_copy_source = False
html_theme_options = {"top_of_page_buttons": []}
