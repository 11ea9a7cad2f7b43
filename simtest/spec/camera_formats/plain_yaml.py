"""YAML of camera files, by PyYAML's safe loader: with OpenCV's tags, without what a calibration never needs.

OpenCV's own reader takes ROS files too, but never returns from some malformed files and crashes on others.
"""

import re
from typing import Any, ClassVar

import yaml

MAX_DEPTH = 32
MAX_VALUES = 100_000
"""Maps, lists and scalars of a file; PyYAML takes about 20 microseconds for each."""

_YAML = "tag:yaml.org,2002:"
_CONSTANTS = {"true": True, "false": False, "null": None, "~": None, "": None}
_NUMBER = re.compile(r"[-+]?((\d+(\.\d*)?|\.\d+)(e[-+]?\d+)?|\.?inf|\.?nan)", re.IGNORECASE)


class _CameraLoader(yaml.SafeLoader):
    """Builds maps, lists, numbers and text; refuses aliases, merge keys, other tags, and files that are too large."""

    yaml_constructors: ClassVar[dict[str | None, Any]] = {}
    yaml_multi_constructors: ClassVar[dict[str | None, Any]] = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._values = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if anchor := getattr(event, "anchor", None):
            sign = "*" if isinstance(event, yaml.AliasEvent) else "&"
            raise _refusal(event, f"{sign}{anchor[:20]}: anchors and aliases are not allowed")
        self._values += 1
        if self._values > MAX_VALUES:
            raise _refusal(event, f"too many values; at most {MAX_VALUES} are allowed")
        if self._depth >= MAX_DEPTH:
            raise _refusal(event, f"nested too deeply; at most {MAX_DEPTH} levels are allowed")
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


def parse_yaml(text: str) -> Any:
    """Read the first document of a YAML file: maps, lists, numbers and text; None if it is empty.

    Tags of OpenCV are allowed and ignored. Keys are text, whatever they look like. Raises `ValueError` if the text is
    no such YAML; the message is one line and begins with the line's number.
    """
    try:
        # OpenCV's header, %YAML:1.0, is no valid directive.
        loader = _CameraLoader(re.sub(r"\A\ufeff?%", "#", text))
        return loader.get_data() if loader.check_data() else None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise ValueError(f"line {line}: {error.problem or error.context}") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ValueError(f"line {line}: {error.reason}") from None
    except ValueError as error:
        # An escape that names no character.
        raise ValueError(f"line 1: {error}") from None


def _refusal(at: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


def _content(loader: _CameraLoader, node: yaml.Node) -> Any:
    """Return a node's content, whatever its tag."""
    if isinstance(node, yaml.ScalarNode):
        return node.value if node.style else _plain_scalar(node.value)
    if isinstance(node, yaml.SequenceNode):
        return [loader.construct_object(item, deep=True) for item in node.value]
    made: dict[str, Any] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _refusal(key, "must be key: value, and the key a word")
        if key.value == "<<":
            raise _refusal(key, "merge keys (<<) are not allowed")
        if key.value in made:
            raise _refusal(key, f"{key.value[:40]} is given twice")
        made[key.value] = loader.construct_object(value, deep=True)
    return made


def _plain_scalar(text: str) -> Any:
    """Return a scalar without quotes as constant, number or text."""
    lowered = text.lower()
    if lowered in _CONSTANTS:
        return _CONSTANTS[lowered]
    if re.fullmatch(r"[-+]?\d{1,18}", text):
        return int(text)
    # YAML writes .inf and .nan, Python inf and nan.
    return float(lowered.replace(".inf", "inf").replace(".nan", "nan")) if _NUMBER.fullmatch(text) else text


def _refuse_tag(_: _CameraLoader, node: yaml.Node) -> Any:
    tag = node.tag.replace(_YAML, "!!")
    raise _refusal(node, f"tag {tag[:40]} is not allowed; only !!opencv-... is")


# PyYAML's own resolvers would read 1e-5 as text, 010 as 8, 12:30 as 750 and 2024-01-01 as a date.
_CameraLoader.yaml_implicit_resolvers = {}
for kind in ("map", "seq", "str", "int", "float", "bool", "null"):
    _CameraLoader.add_constructor(f"{_YAML}{kind}", _content)
_CameraLoader.add_multi_constructor(f"{_YAML}opencv-", lambda loader, _, node: _content(loader, node))
_CameraLoader.add_constructor(None, _refuse_tag)
