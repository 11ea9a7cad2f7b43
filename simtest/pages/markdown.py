"""Text that others wrote, in Markdown and YAML: it shows as it is, and forms neither markup nor keys."""

import json
import re

MAX_TEXT = 300
_SIGNS = (
    ("\\", "\\\\"), ("|", "\\|"), ("`", "'"), ("&", "&amp;"), ("<", "&lt;"), ("@", "&#64;"), ("](", "]\\("),
)  # fmt: skip
"""Signs of Markdown and HTML, and those that mention somebody, with what shows the same."""

_UNPRINTABLE = re.compile("[^\x20-\x7e\xa0-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
"""What YAML does not allow in a quoted text."""


def escaped(value: object, most: int = MAX_TEXT) -> str:
    """Return a text on one line of at most so many characters, without the signs of Markdown or HTML."""
    text = " ".join(str(value).split())
    text = text if len(text) <= most else text[: most - 3] + "..."
    for sign, safe in _SIGNS:
        text = text.replace(sign, safe)
    # At the start of a line these would begin a heading or a list.
    return "\\" + text if text[:1] in ("#", "-", "+", "*", ">", "=", "~") else text


def paragraphs(text: str, most: int = 10_000) -> str:
    """Return a text of several paragraphs, which empty lines separate, each escaped."""
    return "\n\n".join(escaped(part, most) for part in re.split(r"\n\s*\n", text) if part.strip())


def yaml_string(value: object) -> str:
    """Return a text as a quoted string of YAML, on one line."""
    return json.dumps(_UNPRINTABLE.sub("", " ".join(str(value).split())), ensure_ascii=False)
