"""The plain part of YAML in which OpenCV and ROS write calibrations: maps, lists, numbers and text.

OpenCV's own reader takes ROS files too, but does not end on some malformed files and crashes on others.
"""

import re
from collections import deque
from dataclasses import dataclass
from typing import Any

MAX_DEPTH = 32

_KEY = re.compile(r"""^("[^"]*"|'[^']*'|[^\s\[\]{},#&*!|>'"%@`:-][^:\s]*(?:\s+[^:\s]+)*)\s*:(?:\s+(.*))?$""")
_TOKEN = re.compile(r"""\s*([\[\]{},]|"[^"]*"|'[^']*'|:(?=\s)|(?:[^\[\]{},:\s"']|:(?!\s)|\s+(?![\[\]{},:\s]))+)\s*""")
_COMMENT = re.compile(r"""^((?:"[^"]*"|'[^']*'|[^"'#]|(?<=\S)#|["'])*?)(?:(?:^|(?<=\s))#.*)?$""")
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
_FLOATS = {".nan": float("nan"), ".inf": float("inf"), "-.inf": float("-inf"), "+.inf": float("inf")}


@dataclass(frozen=True)
class _Line:
    number: int
    indent: int
    text: str


def parse_yaml(text: str) -> Any:
    """Read the first document of a YAML file.

    Parameters
    ----------
    text : str
        Block maps and lists by indentation, flow lists and maps over several lines, tags (ignored), comments. Anchors
        and text in blocks are refused.

    Returns
    -------
    dict, list, int, float, str, bool or None
        None for an empty document.

    Raises
    ------
    ValueError
        If the text is no such YAML; the message begins with the line's number.
    """
    lines = _lines(text)
    if not lines:
        return None
    value, rest = _block(lines, 0)
    if rest:
        raise ValueError(f"line {rest[0].number}: incorrect indentation")
    return value


def _lines(text: str) -> list[_Line]:
    """Split the first document into lines; those inside brackets are joined."""
    found: list[_Line] = []
    depth = 0
    for number, raw in enumerate(text.split("\n"), 1):
        bare = raw.rstrip()
        if re.match(r"(---|\.\.\.)(\s|$)", bare):
            if found:
                break
            continue
        if bare.startswith("%") and not found:
            continue
        matched = _COMMENT.match(bare)
        kept = (matched[1] if matched else bare).rstrip()
        if not kept.strip():
            continue
        if "\t" in kept[: len(kept) - len(kept.lstrip())]:
            raise ValueError(f"line {number}: a tab in the indentation")
        if depth > 0:
            found[-1] = _Line(found[-1].number, found[-1].indent, f"{found[-1].text} {kept.strip()}")
        else:
            found.append(_Line(number, len(kept) - len(kept.lstrip(" ")), kept.strip()))
        depth += sum((mark in "[{") - (mark in "]}") for mark in re.sub(r"\"[^\"]*\"|'[^']*'", "", kept))
    if depth > 0:
        raise ValueError(f"line {found[-1].number}: a bracket is not closed")
    return found


def _block(lines: list[_Line], depth: int) -> tuple[Any, list[_Line]]:
    """Read the value that begins at the first line's indentation; gives it and the lines after it."""
    if depth > MAX_DEPTH:
        raise ValueError(f"line {lines[0].number}: nested too deeply")
    first = lines[0]
    if re.match(r"-(\s|$)", first.text):
        return _list(lines, depth)
    if not _KEY.match(first.text):
        return _flow(first.text, first.number), lines[1:]
    made: dict[str, Any] = {}
    while lines and lines[0].indent == first.indent:
        line = lines[0]
        matched = _KEY.match(line.text)
        if matched is None:
            raise ValueError(f"line {line.number}: must be key: value")
        key, inline = matched[1].strip("\"'"), re.sub(r"^!\S*\s*", "", matched[2] or "")
        if key in made:
            raise ValueError(f"line {line.number}: {key} is given twice")
        below = lines[1:]
        deeper = below and (
            below[0].indent > line.indent
            or (below[0].indent == line.indent and re.match(r"-(\s|$)", below[0].text))  # a list may stand level
        )
        if inline or not deeper:
            made[key], lines = _flow(inline, line.number), below
        else:
            made[key], lines = _block(below, depth + 1)
    return made, lines


def _list(lines: list[_Line], depth: int) -> tuple[list[Any], list[_Line]]:
    made: list[Any] = []
    indent = lines[0].indent
    while lines and lines[0].indent == indent and re.match(r"-(\s|$)", lines[0].text):
        line = lines[0]
        item = line.text[1:].lstrip()
        if item:
            # What follows the dash begins a value of its own, further in.
            start = _Line(line.number, indent + len(line.text) - len(item), item)
            value, lines = _block([start, *lines[1:]], depth + 1)
        elif len(lines) > 1 and lines[1].indent > indent:
            value, lines = _block(lines[1:], depth + 1)
        else:
            value, lines = None, lines[1:]
        made.append(value)
    return made, lines


def _flow(text: str, number: int) -> Any:
    """Read a value on one line: a scalar, or a list or map in brackets."""
    if not text.startswith(("[", "{")):
        return _scalar(text, number)
    tokens: deque[str] = deque()
    place = 0
    while place < len(text):
        matched = _TOKEN.match(text, place)
        if matched is None:
            raise ValueError(f"line {number}: cannot be read from {text[place : place + 10]!r}")
        tokens.append(matched[1])
        place = matched.end()
    value = _bracket(tokens, number, 0)
    if tokens:
        raise ValueError(f"line {number}: {tokens[0]!r} after the closing bracket")
    return value


def _bracket(tokens: deque[str], number: int, depth: int) -> Any:
    """Read a value from the front of the tokens, and take them away."""
    if depth > MAX_DEPTH:
        raise ValueError(f"line {number}: nested too deeply")
    opening = _next(tokens, number)
    if opening not in ("[", "{"):
        return _scalar(opening, number)
    closing = "]" if opening == "[" else "}"
    items: list[Any] = []
    keyed: dict[str, Any] = {}
    while tokens and tokens[0] != closing:
        item = _bracket(tokens, number, depth + 1)
        if opening == "{":
            if _next(tokens, number) != ":":
                raise ValueError(f"line {number}: missing : after {item!r}")
            keyed[str(item)] = _bracket(tokens, number, depth + 1)
        else:
            items.append(item)
        if tokens and tokens[0] == ",":
            tokens.popleft()
        elif tokens and tokens[0] != closing:
            raise ValueError(f"line {number}: missing , before {tokens[0]!r}")
    if _next(tokens, number) != closing:
        raise ValueError(f"line {number}: missing {closing}")
    return items if opening == "[" else keyed


def _next(tokens: deque[str], number: int) -> str:
    if not tokens:
        raise ValueError(f"line {number}: a bracket is not closed")
    return tokens.popleft()


def _scalar(text: str, number: int) -> Any:
    if len(text) > 1 and text[0] in "\"'" and text[-1] == text[0]:
        return text[1:-1]
    if text[:1] in tuple("&*|>,]}"):
        raise ValueError(f"line {number}: {text[:20]!r} is not supported")
    lowered = text.lower()
    if lowered in _WORDS:
        return _WORDS[lowered]
    if lowered in _FLOATS:
        return _FLOATS[lowered]
    try:
        return int(text) if re.fullmatch(r"[-+]?\d{1,18}", text) else float(text)
    except ValueError:
        return text
