"""Names of estimators and detectors with a network of the user's own: ``learned_spot:models/spots/model.onnx``."""

import re
from dataclasses import dataclass
from pathlib import Path

from simtest.errors import InputError
from simtest.runtime.provenance import file_hash
from simtest.runtime.resources import shown

SUFFIX = ".onnx"

_NAMED = re.compile(rf"(?P<runner>[A-Za-z0-9_.-]+):(?P<file>\S.*{re.escape(SUFFIX)})", re.DOTALL)
"""A command, ``command: python core.py net.onnx``, is none: a blank follows its colon."""


@dataclass(frozen=True)
class ModelName:
    """A name of this form.

    Parameters
    ----------
    runner : str
        The registered name of what runs the network.
    file : Path
        The network.
    """

    runner: str
    file: Path

    @property
    def short(self) -> str:
        """The name in results: the runner's, with the file's, or its folder's where the file is called model.onnx."""
        label = self.file.stem if self.file.stem != "model" else self.file.absolute().parent.name
        return f"{self.runner}_{re.sub('[^A-Za-z0-9_.-]+', '_', label)[:40] or 'model'}"

    @property
    def absolute(self) -> str:
        """The same name in every folder."""
        return f"{self.runner}:{self.file.absolute()}"

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of the file, by path; raise `InputError` if it cannot be read."""
        try:
            return {str(self.file.absolute()): file_hash(self.file)}
        except OSError as error:
            raise InputError(f"{shown(self.file)}: cannot be read ({error.strerror})") from None


def parse_model(text: str) -> ModelName | None:
    """Return the parts of a name of this form; None for all others."""
    found = _NAMED.fullmatch(text)
    return ModelName(found["runner"], Path(found["file"])) if found and found["runner"] != "command" else None
