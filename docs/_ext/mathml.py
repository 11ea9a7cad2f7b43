"""Equations as MathML, made when the manual is built: no script, no font and no network when it is read.

The converter is docutils' own. A command that it does not know is a warning, so that no page shows half an equation.
"""

import re
from html import escape
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

LOGGER = logging.getLogger(__name__)

TAG = re.compile(r"\\tag\{([^}]*)\}")
"""An equation's own number, which the converter does not know."""

BARE_FRACTION = re.compile(r"(\\[dt]?frac) *([0-9A-Za-z]) *([0-9A-Za-z])")
"""A fraction of two single signs without braces, of which the converter would make one number."""


def _mathml(node: nodes.Element, as_block: bool) -> str:
    tex = BARE_FRACTION.sub(r"\1{\2}{\3}", TAG.sub("", node.astext())).strip()
    try:
        return str(tex2mathml(tex, as_block=as_block))
    except MathError as error:
        LOGGER.warning("equation cannot be converted (%s): %s", error, tex, location=node)
        return f"<code>{escape(tex)}</code>"


def inline(self: Any, node: nodes.math) -> None:
    """Write an equation within a line."""
    self.body.append(_mathml(node, as_block=False))
    raise nodes.SkipNode


def block(self: Any, node: nodes.math_block) -> None:
    """Write an equation of its own, with its number, in a box that scrolls where it is wider than the page."""
    tag = TAG.search(node.astext())
    number = f'<span class="eqno">({escape(tag[1])})</span>' if tag else ""
    self.body.append(f'<div class="math">{_mathml(node, as_block=True)}{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer and choose it."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
