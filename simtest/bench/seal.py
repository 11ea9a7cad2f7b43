"""Sealed seeds: a secret that an organiser keeps, and a public commitment to it.

The commitment is the SHA-256 of salt and secret as canonical JSON. It tells nothing of the secret, and no other secret
fits it, so the organiser cannot choose the seeds after the results. Both have a fixed form, 64 digits, so that a
commitment opens in one way.
"""

import json
import os
import re
import secrets
import sys
from pathlib import Path

from simtest.bench.draws import Seeds
from simtest.bench.suite import Suite, digest_of
from simtest.errors import InputError
from simtest.runtime.files import JsonObject, make_folder, require_plain
from simtest.runtime.resources import shown

SEALED, COMMITMENT = "sealed_seeds.json", "commitment.json"
KIND = "simtest-bench sealed seeds"
BYTES = 32

STDIN = "-"
"""In place of a file's name: no process that can read this one's arguments learns where the secret lies."""

MOST_STDIN = 10_000
"""Characters that are read of it."""


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
    return digest_of({"suite": suite.digest, "salt": salt, "secret": secret})


def open_seal(suite: Suite, path: Path) -> Seeds:
    """Read a file of sealed seeds, or standard input where `path` is "-".

    Raises `InputError` if it holds none, or those of another suite.
    """
    where = f"--sealed {shown(path)}"
    try:
        told: JsonObject = json.loads(_read(path))
        kind, of_suite, secret, salt = (told[key] for key in ("kind", "suite", "secret", "salt"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{where}: cannot be read as sealed seeds ({shown(_why(error))})") from error
    if kind != KIND:
        raise InputError(f"{where}: kind = {shown(repr(kind), 60)}; must be {KIND!r}")
    if of_suite != suite.digest:
        raise InputError(f"{where}: is of another suite ({shown(of_suite, 12)}); this one is {suite.digest[:12]}")
    for key, value in (("secret", secret), ("salt", salt)):
        if not isinstance(value, str) or not re.fullmatch(f"[0-9a-f]{{{2 * BYTES}}}", value):
            # The value is not shown: it may be a secret with one digit wrong.
            told_of = f"has {len(value)} characters" if isinstance(value, str) else "is no text"
            raise InputError(f"{where}: {key} {told_of}; must be {2 * BYTES} of 0-9a-f")
    return Seeds(secret, commitment_of(suite, secret, salt))


def _read(path: Path) -> str:
    """Return the text of a file of sealed seeds, or what standard input holds."""
    if str(path) == STDIN:
        return sys.stdin.read(MOST_STDIN)
    return require_plain(path, "record_bytes").read_text(encoding="utf-8")


def _why(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"no key {error}"
    return str(getattr(error, "strerror", None) or error)
