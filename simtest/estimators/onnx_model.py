"""A trained network as an ONNX file with metadata, run by ONNX Runtime: what all learned cores share.

The package onnxruntime (extra ``onnx``) is imported when a network is loaded, not before.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import AnyArray
from simtest.runtime.files import JsonObject, require_plain

METADATA = "simtest"
"""Key of the metadata, a JSON object, in the file."""

LARGEST_MODEL_BYTES = 256 * 2**20


class OnnxModel:
    """A trained network in ONNX Runtime, on one thread of the processor.

    Parameters
    ----------
    path : Path
        The file.
    form : str
        Value of the metadata's key ``format``: which inputs, outputs and metadata the network has.
    core : str
        Name of the core that needs the network, for messages.

    Attributes
    ----------
    content : dict
        The metadata; read it inside of `reading`.
    """

    def __init__(self, path: Path, form: str, core: str) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise InputError(f"{core} needs the package onnxruntime: install the extra onnx") from None
        self._path, self._form, self._core = path, form, core
        data = _bytes(path)
        options = onnxruntime.SessionOptions()
        # The harness divides the cores among its workers.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what is wrong is in the exception
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
            text = self._session.get_modelmeta().custom_metadata_map.get(METADATA, "")
        except Exception as error:  # its exceptions share no base but this
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: is no ONNX model ({reason!s:.100})") from None
        with self.reading():
            self.content: JsonObject = json.loads(text)
            if self.content["format"] != form:
                raise ValueError(f"format {self.content['format']!r}")

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Turn errors of a block that reads the metadata into an `InputError` that names the file."""
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise InputError(
                f"{self._path}: is no network for {self._core} ({type(error).__name__}: {error!s:.80}); "
                f"its metadata must hold {METADATA!r} of the form {self._form!r}"
            ) from None

    def run(self, inputs: Mapping[str, AnyArray], shapes: Mapping[str, tuple[int | None, ...]]) -> list[AnyArray]:
        """Return outputs of the network by name.

        Parameters
        ----------
        inputs : mapping
            Arrays of float32 by name.
        shapes : mapping
            Names of the wanted outputs with their shapes; None stands for any number.
        """
        try:
            made = [np.asarray(each) for each in self._session.run(list(shapes), dict(inputs))]
            for (name, shape), array in zip(shapes.items(), made, strict=True):
                if len(shape) != array.ndim or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
                    raise ValueError(f"{name} has the shape {array.shape}; must be {_told(shape)}")
                if array.dtype.kind != "f":
                    raise ValueError(f"{name} holds {array.dtype}; must be floating-point numbers")
                if not np.isfinite(array).all():
                    raise ValueError(f"{name} holds values that are not finite")
        except Exception as error:  # of ONNX Runtime, as above
            reason = " ".join(str(error).split())
            raise InputError(f"{self._path}: cannot be run ({reason!s:.120})") from None
        return made


def _told(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def _bytes(path: Path) -> bytes:
    """Return a file's content; raise `InputError` if it cannot be read or is too large."""
    try:
        size = require_plain(path).stat().st_size
        if size > LARGEST_MODEL_BYTES:
            raise InputError(f"{path}: has {size} bytes; may have {LARGEST_MODEL_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
