"""What studies keep between calls, known by the code that made it: no table mixes versions."""

import hashlib
import json
from functools import cache
from pathlib import Path

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
