"""Templates of the pages, and text that may stand inside them."""

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simtest.pages import style
from simtest.runtime.arrays import cache_folder
from simtest.runtime.files import as_json

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

_PACKAGE = Path(__file__).resolve().parents[1]
TEMPLATES = [
    _PACKAGE / "pages" / "templates",
    *(
        _PACKAGE / room
        for room in (
            "report",
            "advice",
            "advice/twin",
            "realism",
            "reconstruction",
            "nightly",
            "bench",
            "dataset",
            "dataset/scoring/dense",
        )
    ),
]


def environment() -> "Environment":
    """Return the templates of all rooms: text is escaped, and a name that is not given is an error."""
    from jinja2 import Environment, FileSystemBytecodeCache, FileSystemLoader, StrictUndefined
    from jinja2.bccache import Bucket

    class Compiled(FileSystemBytecodeCache):
        """Compiled templates in the user's cache; what cannot be kept there is compiled again."""

        def load_bytecode(self, bucket: Bucket) -> None:
            with suppress(OSError):
                super().load_bytecode(bucket)

        def dump_bytecode(self, bucket: Bucket) -> None:
            with suppress(OSError):
                Path(self.directory).mkdir(parents=True, exist_ok=True)
                super().dump_bytecode(bucket)

    folder = cache_folder()
    made = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, bytecode_cache=Compiled(str(folder)) if folder else None,
    )  # fmt: skip
    made.filters |= {
        "degrees": style.degrees,
        "number": style.number,
        "breakable": breakable,
        "capitalize_first": capitalize_first,
        "code_spans": code_spans,
    }
    # The templates' own marks take the palette's colours: these stand out on both grounds.
    made.globals |= {"neutral": style.NEUTRAL, "accents": style.ESTIMATOR_COLOURS}
    return made


def write_page(path: Path, template: str, data: Any, **values: Any) -> None:
    """Render a template and write it; `data` stands in it as JSON for the page's script."""
    from markupsafe import Markup

    # Escaped as JSON within a script is: `script_json` leaves no "<".
    html = environment().get_template(template).render(data=Markup(script_json(data)), **values)  # nosec B704
    path.write_text(html, encoding="utf-8")


def capitalize_first(text: str) -> str:
    """Return a text with a capital at its start, and else as it is."""
    return text[:1].upper() + text[1:]


def code_spans(text: str) -> "Markup":
    """Return a text whose parts between backticks are set as code."""
    from markupsafe import Markup, escape

    parts = text.split("`")
    # An odd backtick at the end opens nothing.
    if len(parts) % 2 == 0:
        parts[-2:] = ["`".join(parts[-2:])]
    spans = [Markup("<code>{}</code>").format(part) if i % 2 else escape(part) for i, part in enumerate(parts)]
    return Markup("").join(spans)


def breakable(name: str) -> "Markup":
    """Return a name that may be broken behind its underscores, where a column is narrow."""
    from markupsafe import Markup, escape

    # The name is escaped before the marks are put in.
    return Markup(str(escape(name)).replace("_", "_<wbr>"))  # nosec B704


def script_json(value: Any) -> str:
    """Return a value as compact JSON that may stand inside a script element."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), default=as_json)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
