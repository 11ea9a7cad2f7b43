"""Requests and answers as files, for cores that read no binary streams: JSON, NPY and PNG in a folder a request."""

import io
import os
import shutil
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import SimtestError
from simtest.estimators.process.child import Child
from simtest.estimators.process.wire import (
    MAX_ARRAY_BYTES,
    MAX_ARRAYS,
    MAX_HEADER_BYTES,
    Message,
    broken,
    encode,
    excerpt,
    parse_header,
    to_line,
)

PICTURE = "encoded"
"""The array that is written as a picture too."""


def exchange(
    child: Child, request: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], limit_s: float
) -> Message:
    """Write a request's files, send a line that names their folder, and read the answer's files.

    Raises
    ------
    CoreFault
        If the core breaks down, or its answer is malformed or missing.
    """
    number = request["id"]
    folder = Path(child.folder) / f"request-{number}"
    try:
        _write(folder, request, arrays)
    except (FileExistsError, FileNotFoundError, NotADirectoryError, PermissionError) as error:
        raise broken(f"changed the folder that it runs in: no folder for a request ({error.strerror})") from None
    except OSError as error:
        raise SimtestError(f"{folder}: cannot be written ({error.strerror or error})") from error
    try:
        line = {"type": request["type"], "id": number, "folder": str(folder)}
        said = child.exchange(encode(line, {}), limit_s)
        # An answer that fits on the line needs no file.
        if said.header.get("type") != "done":
            return said
        if said.header.get("id") != number:
            raise broken(
                f"a line of type done with id {excerpt(repr(said.header.get('id')).encode(), 60)} to request {number}"
            )
        told = _read(folder)
        return Message({"id": said.header.get("id"), **told.header}, told.arrays)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(folder: Path, request: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    folder.mkdir()
    listed = []
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", np.ascontiguousarray(array), allow_pickle=False)
        listed.append({"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "file": f"{name}.npy"})
    if PICTURE in arrays:
        _write_picture(folder / f"{PICTURE}.png", arrays[PICTURE])
    (folder / "request.json").write_bytes(to_line({**request, "arrays": listed}))


def _write_picture(path: Path, values: npt.NDArray[Any]) -> None:
    """Write values in [0, 1] as PNG of 16 bits."""
    import cv2

    steps = np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16)
    if not cv2.imwrite(str(path), steps[..., ::-1] if steps.ndim == 3 else steps):
        raise OSError(f"{path}: cannot be written")


def _read(folder: Path) -> Message:
    """Read answer.json, and the arrays that it lists."""
    header = parse_header(_content(folder, "answer.json", MAX_HEADER_BYTES))
    listed, left, arrays = header.pop("arrays", []), MAX_ARRAY_BYTES, {}
    if not isinstance(listed, list) or len(listed) > MAX_ARRAYS:
        raise broken(f"arrays: must be a list of at most {MAX_ARRAYS}")
    for entry in listed:
        name = entry.get("name") if isinstance(entry, dict) else entry
        if not isinstance(name, str) or not name.replace("_", "").replace(".", "").isalnum() or name in arrays:
            raise broken("arrays: each must have a name of its own, of letters, digits, points and underscores")
        content = _content(folder, f"{name}.npy", left)
        left -= len(content)
        try:
            array = np.load(io.BytesIO(content), allow_pickle=False)
        # A header may claim any size and type.
        except Exception as error:
            raise broken(f"{name}.npy cannot be read ({excerpt(str(error).encode())})") from None
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
            raise broken(f"{name}.npy: must be an array of numbers")
        arrays[name] = array
    return Message(header, arrays)


def _content(folder: Path, name: str, most: int) -> bytes:
    """Read a plain file of the folder; links are not followed, and pipes not waited for."""
    try:
        opened = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise broken(f"{name} cannot be read ({error.strerror})") from None
    try:
        found = os.fstat(opened)
        if not stat.S_ISREG(found.st_mode) or found.st_size > most:
            raise broken(f"{name}: must be a plain file of at most {most} bytes")
        with open(opened, "rb", closefd=False) as file:
            return file.read(most)
    finally:
        os.close(opened)
