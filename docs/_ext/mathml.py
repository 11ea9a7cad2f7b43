"""Equations as MathML, made when the manual is built: no script, no font and no network when it is read."""

from html import escape
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging

LOGGER = logging.getLogger(__name__)


def _mathml(self: Any, node: nodes.Element, display: str) -> str:
    """Return an equation's MathML; one that cannot be converted, or not whole, is a warning."""
    tex = node.astext()
    try:
        made = convert(tex, display=display)
    except Exception as error:  # the converter raises its own kinds, and IndexError on unbalanced braces
        LOGGER.warning("equation cannot be converted (%s): %s", error, tex, location=node)
        return f"<code>{escape(tex)}</code>"
    # The converter shows a command that it does not know as its name.
    if "\\" in made:
        LOGGER.warning("equation holds a command that has no MathML: %s", tex, location=node)
    return made


def inline(self: Any, node: nodes.math) -> None:
    """Write an equation within a line."""
    self.body.append(_mathml(self, node, "inline"))
    raise nodes.SkipNode


def block(self: Any, node: nodes.math_block) -> None:
    """Write an equation of its own, in a box that scrolls where it is wider than the page."""
    label = node.get("label")
    anchor = f' id="equation-{nodes.make_id(label)}"' if label else ""
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    self.body.append(f'<div class="math"{anchor}>{_mathml(self, node, "block")}{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer and choose it."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
