"""What all pages share: templates, JSON inside scripts, plotly's bundle and embedded pictures."""

import base64
import io
import json
import zlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

_PACKAGE = Path(__file__).resolve().parents[1]
TEMPLATES = [
    _PACKAGE / "pages" / "templates",
    *(_PACKAGE / room for room in ("report", "reconstruction", "nightly/page")),
]
_WORSE = ((640, 85), (640, 70), (560, 60), (480, 50), (420, 40))
"""Width, px, and quality of an embedded picture, tried until it is small enough."""


def environment() -> "Environment":
    """Give the templates of this package: text is escaped, and a name that is not given is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from simtest.pages import style

    made = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {"degrees": style.degrees, "number": style.number, "breakable": breakable}
    return made


def write_page(path: Path, template: str, data: Any, **values: Any) -> None:
    """Render a template and write it; `data` stands in it as JSON for the page's script."""
    from markupsafe import Markup

    html = environment().get_template(template).render(data=Markup(script_json(data)), **values)
    path.write_text(html, encoding="utf-8")


def breakable(name: str) -> "Markup":
    """Give a name that may be broken behind its underscores, where a column is narrow."""
    from markupsafe import Markup, escape

    return Markup(str(escape(name)).replace("_", "_<wbr>"))


def script_text(text: str) -> str:
    """Give JSON so that it may stand inside a script element."""
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def script_json(value: Any) -> str:
    """Write a value as compact JSON that may stand inside a script element."""
    return script_text(json.dumps(value, allow_nan=False, separators=(",", ":")))


@cache
def packed_plotly() -> str:
    """Give plotly's bundle, compressed to two fifths, for the template ``parts/plotly.html.j2`` to unpack.

    Returns
    -------
    str
        zlib's format as base64.
    """
    from plotly.offline import get_plotlyjs

    return base64.b64encode(zlib.compress(str(get_plotlyjs()).encode(), 9)).decode("ascii")


def picture(path: Path, limit: int) -> str:
    """Give a PNG as a data address of a WebP picture.

    Parameters
    ----------
    path : pathlib.Path
        The picture.
    limit : int
        Wanted size in bytes; quality and then width are lowered until it is met, but not below 40 and 420 px.

    Returns
    -------
    str
        ``data:image/webp;base64,...``
    """
    from PIL import Image

    with Image.open(path) as source:
        image = source.convert("RGB")
    data = b""
    for width, quality in _WORSE:
        if image.width > width:
            image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        image.save(buffer, "WEBP", quality=quality)
        data = buffer.getvalue()
        if len(data) <= limit:
            break
    return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")
