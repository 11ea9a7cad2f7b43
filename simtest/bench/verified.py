"""A list of the certificates that were run again: its owner's own, so that no contributor can add to it."""

import json
from pathlib import Path

from simtest.bench.certificate import Certificate
from simtest.bench.compare import Verified
from simtest.errors import InputError
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, require_plain
from simtest.runtime.resources import shown

AGAIN, FAILS, STATED = "run again", "does not hold", "as stated"
"""What a table says of a certificate: it was run again and holds or not, or nobody has run it here."""


def keep_verified(path: Path, certificate: Certificate, found: Verified) -> None:
    """Add what a verification by a run found to a list, a line of JSON each."""
    read_verified(path)
    line = {"certificate": certificate.digest, "core": certificate.core["name"], "holds": found.holds,
            "problems": list(found.problems), "simtest": provenance.version()}  # fmt: skip
    make_folder(path.parent, "--verified")
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise InputError(f"--verified {shown(path)}: cannot be written ({error.strerror})") from error


def read_verified(path: Path, required: bool = False) -> dict[str, bool]:
    """Read a list: whether each certificate holds, by its hash; the last line of each counts.

    Raises `InputError` if the file is no such list, or is missing where it is `required`.
    """
    try:
        if not required and not path.exists():
            return {}
        held: dict[str, bool] = {}
        for line in require_plain(path, "record_bytes").read_text(encoding="utf-8").splitlines():
            told = json.loads(line)
            held[str(told["certificate"])] = told["holds"] is True
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise InputError(
            f"--verified {shown(path)}: cannot be read as a list of verified certificates ({why})"
        ) from error
    return held


def mark_of(certificate: Certificate, verified: dict[str, bool]) -> str:
    """Return what a table says of a certificate."""
    holds = verified.get(certificate.digest)
    return STATED if holds is None else AGAIN if holds else FAILS
