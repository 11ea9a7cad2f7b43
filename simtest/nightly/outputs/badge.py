"""A badge with the verdict as SVG, drawn here so that it needs no service and no font of its own."""

from xml.sax.saxutils import escape

from simtest.nightly.phrases import headline
from simtest.nightly.records import JudgedRun

# White on these has a contrast of 4.5 or more (WCAG AA).
COLOURS = {"fine": "#1a7f37", "changed": "#9a6700", "regression": "#c62828", "no baseline": "#5f6368"}
_LEFT = "#444444"

_CHARACTER_PX, _PADDING_PX, _HEIGHT_PX = 7.0, 10.0, 20


def badge(judged: JudgedRun) -> str:
    """Return the badge as SVG text."""
    left, right = f"nightly {judged.run.record.profile}", headline(judged.verdict)
    widths = [round(len(text) * _CHARACTER_PX + 2 * _PADDING_PX) for text in (left, right)]
    texts = "".join(
        # The length is stated, since the reader's font may be wider than ours.
        f'<text x="{x:g}" y="14" textLength="{len(text) * _CHARACTER_PX:g}" lengthAdjust="spacingAndGlyphs">'
        f"{escape(text)}</text>"
        for text, x in ((left, _PADDING_PX), (right, widths[0] + _PADDING_PX))
    )
    total = sum(widths)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{total}" height="{_HEIGHT_PX}" '
        f'viewBox="0 0 {total} {_HEIGHT_PX}" role="img" aria-labelledby="title">'
        f'<title id="title">{escape(f"{left}: {right}")}</title>'
        f'<rect width="{widths[0]}" height="{_HEIGHT_PX}" fill="{_LEFT}"/>'
        f'<rect x="{widths[0]}" width="{widths[1]}" height="{_HEIGHT_PX}" fill="{COLOURS[judged.verdict.state]}"/>'
        f'<g fill="#ffffff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">{texts}</g></svg>\n'
    )
