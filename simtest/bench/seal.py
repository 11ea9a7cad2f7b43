"""Sealed seeds: a secret that an organiser keeps, and a public commitment to it.

The commitment is the SHA-256 of salt and secret. It tells nothing of the secret, and no other secret fits it, so the
organiser cannot choose the seeds after the results. Both have a fixed length: otherwise one text could be split into
salt and secret in several ways.
"""

import hashlib
import json
import os
import re
import secrets
from pathlib import Path

from simtest.bench.draws import Seeds
from simtest.bench.suite import Suite
from simtest.errors import InputError
from simtest.runtime.files import JsonObject, make_folder, require_plain
from simtest.runtime.resources import shown

SEALED, COMMITMENT = "sealed_seeds.json", "commitment.json"
KIND = "simtest-bench sealed seeds"
BYTES = 32


def seal(suite: Suite, folder: Path) -> str:
    """Draw a secret and write it and its commitment into a folder; return the commitment.

    The file of the secret is readable by its owner alone. A secret that is there is never replaced.

    Raises
    ------
    InputError
        If the folder cannot be made or holds a secret.
    """
    make_folder(folder)
    secret, salt = secrets.token_hex(BYTES), secrets.token_hex(BYTES)
    held = {"kind": KIND, "suite": suite.digest, "version": suite.version, "secret": secret, "salt": salt}
    path, commitment = folder / SEALED, commitment_of(suite, secret, salt)
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(json.dumps(held, indent=2) + "\n")
    except FileExistsError:
        raise InputError(f"{shown(path)}: holds sealed seeds, which are never replaced; name another --out") from None
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be written ({error.strerror})") from error
    public = {"kind": f"{KIND}: commitment", "suite": suite.digest, "version": suite.version, "commitment": commitment}
    (folder / COMMITMENT).write_text(json.dumps(public, indent=2) + "\n", encoding="utf-8")
    return commitment


def commitment_of(suite: Suite, secret: str, salt: str) -> str:
    """Return the commitment to a secret."""
    return hashlib.sha256(f"{suite.digest} {salt} {secret}".encode()).hexdigest()


def open_seal(suite: Suite, path: Path) -> Seeds:
    """Read a file of sealed seeds; raise `InputError` if it is none, or is of another suite."""
    try:
        told: JsonObject = json.loads(require_plain(path, "record_bytes").read_text(encoding="utf-8"))
        kind, of_suite, secret, salt = (str(told[key]) for key in ("kind", "suite", "secret", "salt"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"--sealed {shown(path)}: cannot be read as sealed seeds ({_why(error)})") from error
    if kind != KIND:
        raise InputError(f"--sealed {shown(path)}: kind = {shown(kind, 60)!r}; must be {KIND!r}")
    if of_suite != suite.digest:
        raise InputError(
            f"--sealed {shown(path)}: is of another suite ({shown(of_suite, 12)}); this one is {suite.digest[:12]}"
        )
    for key, value in (("secret", secret), ("salt", salt)):
        if not re.fullmatch(f"[0-9a-f]{{{2 * BYTES}}}", value):
            raise InputError(
                f"--sealed {shown(path)}: {key} has {len(value)} characters; must be {2 * BYTES} of 0-9a-f"
            )
    return Seeds(secret, commitment_of(suite, secret, salt))


def _why(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"no key {error}"
    return str(getattr(error, "strerror", None) or error)
