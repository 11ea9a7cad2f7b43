"""What studies keep between calls, known by the code that made it: no table mixes versions."""

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from simtest.runtime.arrays import Array
from simtest.runtime.files import write_atomically
from simtest.runtime.provenance import source_hash, versions
from simtest.runtime.resources import data_root


@cache
def code_hash() -> str:
    """Return a hash of what results hang on: simtest, its scenes, package versions, and the studies, which mix."""
    digest = hashlib.sha256((source_hash() + json.dumps(versions())).encode())
    for path in sorted([*Path(__file__).parent.rglob("*.py"), *data_root("scenes").rglob("*.toml")]):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def of_this_code(folder: Path) -> Path:
    """Return the folder below a folder for what today's code makes; what other code made there is left alone."""
    return folder / code_hash()[:16]


def write_arrays(file: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays by name as an npz file, whole or not at all."""

    def write(part: Path) -> None:
        # An open file: given a path NumPy would append ".npz" to it.
        with part.open("wb") as opened:
            np.savez_compressed(opened, allow_pickle=False, **arrays)

    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, write)
