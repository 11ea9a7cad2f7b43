"""The certificate of a run: what was run, on what, by which core, with which results; checked when it is read."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simtest.bench.certificate_form import CertificateForm
from simtest.bench.suite import SUITES, Suite, digest_of, layout_of
from simtest.errors import InputError
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject, require_plain, write_json
from simtest.spec.spec_model import validate

CERTIFICATE = "certificate.json"
KIND = "simtest-bench certificate"
FORMAT = 2

OF_CERTIFICATE = "sha256"
"""Key of the hash of everything else."""

_KEYS = CertificateForm.model_fields.keys()


@dataclass(frozen=True)
class Certificate:
    """A certificate that was read and checked.

    Parameters
    ----------
    path : Path
        Of its file.
    content : dict
        As it stands there, without its own hash.
    digest : str
        Its own hash.
    """

    path: Path
    content: JsonObject
    digest: str = ""

    @property
    def core(self) -> JsonObject:
        """Name, version and hashes of the core."""
        return dict(self.content["core"])

    @property
    def parts(self) -> dict[str, JsonObject]:
        """Figures by part."""
        return dict(self.content["parts"])


def environment() -> JsonObject:
    """Return what of the machine and its packages the figures may depend on; neither paths nor the host's name."""
    made_by: dict[str, Any] = dict(provenance.environment())
    # The kernel says nothing of the figures, and its text may name the host.
    del made_by["system"]
    return made_by | {"source_sha256": provenance.source_hash()}


def suite_record(suite: Suite) -> JsonObject:
    """Return what a certificate tells of its suite."""
    return {"name": suite.spec.name, "version": suite.version, "sha256": suite.digest}


def cases_of(suite: Suite, parts: Iterable[str]) -> dict[str, str]:
    """Return the hashes of the cases of some parts, by part and name."""
    return {case.name: case.digest for part in parts for case in suite.of_part(part)}


def write_certificate(folder: Path, content: JsonObject) -> Path:
    """Write a certificate into a run's folder, with the hash of its content."""
    path = folder / CERTIFICATE
    plain = json.loads(json.dumps(content, allow_nan=False))
    write_json(path, {**plain, OF_CERTIFICATE: digest_of(plain)})
    return path


def read_certificate(path: Path) -> Certificate:
    """Read a certificate."""
    if path.is_dir():
        path = path / CERTIFICATE
    require_plain(path, "record_bytes", "a certificate")
    try:
        told = _parsed(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as a certificate ({error})") from error
    if not isinstance(told, dict) or told.get("kind") != KIND:
        raise InputError(f"{path}: is no certificate; its kind must be {KIND!r}")
    if told.get("format") != FORMAT:
        raise InputError(f"{path}: format = {told.get('format')!s:.20}; this release reads {FORMAT}")
    stated = told.pop(OF_CERTIFICATE, None)
    if missing := sorted(_KEYS - told.keys()):
        raise InputError(f"{path}: has no key {missing[0]}; a certificate has {', '.join(sorted(_KEYS))}")
    if not isinstance(stated, str) or stated != digest_of(told):
        raise InputError(f"{path}: was altered: its content does not have the hash that it states")
    validate(CertificateForm, told, str(path))
    return Certificate(path, told, stated)


def _parsed(text: str) -> Any:
    """Return what JSON text holds; raise `ValueError` for what has no hash or no one meaning."""

    def once(pairs: list[tuple[str, Any]]) -> JsonObject:
        if len(table := dict(pairs)) < len(pairs):
            raise ValueError("a key stands twice")
        return table

    def finite(number: str) -> float:
        if not math.isfinite(value := float(number)):
            raise ValueError(f"{number}: must be a finite number")
        return value

    told = json.loads(text, object_pairs_hook=once, parse_float=finite, parse_constant=finite)
    # What is nested too deeply to be written has no hash.
    digest_of(told)
    return told


def check_suite(certificate: Certificate, suite: Suite) -> None:
    """Raise `InputError` where a certificate is of other cases or scenes than a suite's."""
    told = certificate.content["suite"]
    if told.get("version") != suite.version:
        own = SUITES.get(suite.version, suite.version)
        raise InputError(f"{certificate.path}: is of version {told.get('version')!r:.20}; must be of {own}")
    for part in certificate.parts:
        if part not in {each.name for each in suite.spec.parts}:
            raise InputError(f"{certificate.path}: part {part!r} is none of {SUITES[suite.version]}")
    stated, frozen = certificate.content["cases"], cases_of(suite, certificate.parts)
    for name in (*stated, *frozen):
        if name not in frozen or stated.get(name) != frozen[name]:
            raise InputError(f"{certificate.path}: case {name} is not that of {SUITES[suite.version]}")
    if told.get("sha256") != suite.digest:
        raise InputError(f"{certificate.path}: its suite's hash is not that of {SUITES[suite.version]}")
    for part, figures in certificate.parts.items():
        layout = {case: scenes for case, (scenes, _) in layout_of(suite, part).items()}
        if {case: len(held) for case, held in figures["scenes"].items()} != layout:
            wanted = ", ".join(f"{count} of {case}" for case, count in layout.items())
            raise InputError(f"{certificate.path}: parts.{part}.scenes: must be {wanted}")
