"""Messages between simtest and a core: one JSON object on a line, followed by the raw bytes of the arrays it lists."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import Reason

PROTOCOL = 1
"""Version of the protocol."""

DTYPES = ("<f8", "<f4", "<u2", "|u1", "<i4", "|b1")
"""Element types of arrays, as NumPy writes them."""

MAX_HEADER_BYTES = 1 << 20
MAX_ARRAY_BYTES = 64 << 20
"""Of all arrays of one answer together."""

MAX_ARRAYS = 64
MAX_DIMENSIONS = 4


class CoreFault(Exception):
    """A core broke the protocol, died or took too long.

    Parameters
    ----------
    reason : Reason
        ``core_died``, ``core_timeout`` or ``core_protocol``.
    detail : str
        One line.
    """

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.reason, self.detail = reason, detail


def broken(detail: str) -> CoreFault:
    """Return the fault of a core that does not keep to the protocol."""
    return CoreFault(Reason.CORE_PROTOCOL, detail)


@dataclass(frozen=True)
class Message:
    """A message.

    Parameters
    ----------
    header : dict
        The JSON object, without ``arrays``.
    arrays : dict of str to ndarray
        By name.
    """

    header: dict[str, Any]
    arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict)


def encode(header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> list[memoryview]:
    """Return the bytes of a message: its line, then each array in C order.

    Values that JSON does not have, NaN and infinity, are sent as null. An array of another type is sent as ``<f8``.
    """
    sent = {name: _sendable(array) for name, array in arrays.items()}
    listed = [{"name": name, "dtype": a.dtype.str, "shape": list(a.shape)} for name, a in sent.items()]
    line = to_line({**header, "arrays": listed} if sent else header)
    return [memoryview(line), *(a.data.cast("B") for a in sent.values() if a.size)]


def to_line(header: Mapping[str, Any]) -> bytes:
    """Return a header as one line of JSON."""
    return json.dumps(finite(header), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def finite(value: Any) -> Any:
    """Return a JSON value with None in place of numbers that are not finite, and lists in place of arrays."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    return [finite(each) for each in value] if isinstance(value, list | tuple) else value


def _sendable(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    little = array.dtype.newbyteorder("<")
    return np.ascontiguousarray(array, dtype=little if little.str in DTYPES else "<f8")


def parse_header(line: bytes) -> dict[str, Any]:
    """Return the JSON object of a line; raise `CoreFault` where it is none. NaN and Infinity are read as such."""
    try:
        header = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise broken(f"a line that is no JSON: {excerpt(line)} ({excerpt(str(error).encode(), 60)})") from None
    if not isinstance(header, dict):
        raise broken(f"a line that is no JSON object: {excerpt(line)}")
    return header


def excerpt(content: bytes, most: int = 80) -> str:
    """Return the beginning of what a core wrote, printable and on one line."""
    text = content[: 4 * most].decode("utf-8", "replace")
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= most else text[: most - 3] + "..."


class MessageReader:
    """Puts messages together from the bytes of a pipe, and holds no more of them than the limits allow."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._header: dict[str, Any] | None = None
        self._listed: list[tuple[str, np.dtype[Any], tuple[int, ...]]] = []
        self._needed = 0

    @property
    def waiting(self) -> int:
        """Bytes that have come of a message that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Message | None:
        """Take more bytes; return the message where they complete it.

        Raises
        ------
        CoreFault
            If a line is too long or no JSON object, lists malformed or too large arrays, or is followed by bytes that
            belong to no message.
        """
        self._buffer += data
        if self._header is None:
            end = self._buffer.find(b"\n", 0, MAX_HEADER_BYTES + 1)
            if end < 0:
                if len(self._buffer) > MAX_HEADER_BYTES:
                    raise broken(f"a line longer than {MAX_HEADER_BYTES} bytes: {excerpt(bytes(self._buffer[:400]))}")
                return None
            self._header = parse_header(bytes(self._buffer[:end]))
            # A greeting is followed by no arrays: it lists the names of those that the core wants.
            is_hello = self._header.get("type") == "hello"
            self._listed = [] if is_hello else list(_listed(self._header.pop("arrays", [])))
            self._needed = sum(dtype.itemsize * math.prod(shape) for _, dtype, shape in self._listed)
            if self._needed > MAX_ARRAY_BYTES:
                raise broken(f"arrays of {self._needed} bytes; at most {MAX_ARRAY_BYTES}")
            del self._buffer[: end + 1]
        if len(self._buffer) < self._needed:
            return None
        if len(self._buffer) > self._needed:
            extra = bytes(self._buffer[self._needed : self._needed + 400])
            raise broken(f"more than one answer to a request: {excerpt(extra) or 'an empty line'}")
        message = Message(self._header, dict(self._cut()))
        self._buffer, self._header = bytearray(), None
        return message

    def _cut(self) -> Iterator[tuple[str, npt.NDArray[Any]]]:
        start = 0
        for name, dtype, shape in self._listed:
            count = math.prod(shape)
            yield (
                name,
                np.frombuffer(self._buffer, dtype, count, start).reshape(shape) if count else np.empty(shape, dtype),
            )
            start += count * dtype.itemsize


def _listed(given: object) -> Iterator[tuple[str, np.dtype[Any], tuple[int, ...]]]:
    """Return name, type and shape of each array that a header lists; raise `CoreFault` where they are malformed."""
    if not isinstance(given, list) or len(given) > MAX_ARRAYS:
        raise broken(f"arrays: must be a list of at most {MAX_ARRAYS}")
    names = set()
    for entry in given:
        if not isinstance(entry, dict) or not isinstance(name := entry.get("name"), str) or name in names:
            raise broken("arrays: each must be an object with a name of its own")
        names.add(name)
        dtype, shape = entry.get("dtype"), entry.get("shape")
        what = f"array {excerpt(name.encode('utf-8', 'replace'), 40)!r}"
        if dtype not in DTYPES:
            raise broken(f"{what}: dtype {excerpt(str(dtype).encode(), 40)!r}; must be one of {', '.join(DTYPES)}")
        sizes = isinstance(shape, list) and all(isinstance(n, int) and not isinstance(n, bool) for n in shape)
        if not isinstance(shape, list) or not sizes or len(shape) > MAX_DIMENSIONS or not _in_range(shape):
            told = excerpt(json.dumps(shape).encode(), 40)
            raise broken(f"{what}: shape {told}; must be at most {MAX_DIMENSIONS} lengths from 0 to {MAX_ARRAY_BYTES}")
        yield name, np.dtype(dtype), tuple(shape)


def _in_range(shape: list[int]) -> bool:
    return all(0 <= length <= MAX_ARRAY_BYTES for length in shape)
