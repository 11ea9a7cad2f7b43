"""The manifest: what a dataset is, what it was made from, and which of its files are finished."""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue, StrictInt
from typing_extensions import TypedDict

from simtest.dataset.plan import Plan
from simtest.errors import InputError
from simtest.estimators.names import core_hashes, short_name
from simtest.runtime import provenance
from simtest.runtime.files import check_limit, write_json
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate

NAME = "manifest.json"
FORMAT = "simtest dataset, version 2"


class ManifestError(Exception):
    """The manifest cannot be used; the text names the reason."""


class Origin(TypedDict):
    """What determines a dataset's bytes besides its specification: from the same origin the same bytes come."""

    versions: dict[str, str]
    source: str
    variant: str
    inputs: dict[str, str]


class FileEntry(BaseModel):
    """A finished file: its size in bytes, and the SHA-256 of its content."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bytes: StrictInt
    sha256: str

    def wrong_size(self, path: Path) -> str:
        """Return what is wrong with the size of the file as it is; nothing where it is right."""
        size = path.stat().st_size
        return "" if size == self.bytes else f"has {size} bytes; must have {self.bytes}"


# Whoever writes a manifest can write its digest too, so what it lists is not trusted: a name that leaves the folder is
# never opened.
_PLAIN = "[A-Za-z0-9_][A-Za-z0-9._-]{0,200}"
Files = dict[Annotated[str, Field(pattern=f"^({_PLAIN}/)?{_PLAIN}$")], FileEntry]


class Manifest(BaseModel):
    """Record of a dataset's folder, updated as files are finished."""

    complete: bool  # all shards, tables and the card are there
    dataset: dict[str, JsonValue]  # the whole specification, as JSON
    origin: Origin  # versions, source, variant and hashes of the inputs
    environment: dict[str, str | None]  # commit, Python and processor
    shards: Files  # finished shards by name
    tables: Files  # finished tables and card by name: the rows of finished shards, the others once all shards are

    def save(self, folder: Path) -> None:
        """Write the manifest, with a digest of its own content."""
        content = {"format": FORMAT, **self.model_dump()}
        content |= {key: dict(sorted(content[key].items())) for key in ("shards", "tables")}
        write_json(folder / NAME, {**content, "digest": _digest(content)})

    def plan(self) -> Plan:
        """Return the dataset's plan."""
        return Plan(validate(Dataset, self.dataset, NAME))


def new_manifest(plan: Plan, variant: str) -> Manifest:
    """Describe a dataset that is about to be made."""
    origin: Origin = {
        "versions": provenance.versions(),
        "source": provenance.source_hash(),
        "variant": variant,
        "inputs": _input_hashes(plan),
    }
    found = provenance.environment()
    environment = {name: found[name] for name in ("commit", "python", "processor", "system")}
    dataset = plan.dataset.model_dump(mode="json")
    return Manifest(complete=False, dataset=dataset, origin=origin, environment=environment, shards={}, tables={})


def _input_hashes(plan: Plan) -> dict[str, str]:
    """Return the hashes of scenes, recipes, meshes and files of cores, named without the folders of this machine."""
    listed = [(path.name, provenance.file_hash(path)) for path in plan.inputs]
    for name, hashes in core_hashes(plan.dataset.estimators).items():
        listed += [(f"core {short_name(name)}: {Path(path).name}", digest) for path, digest in hashes.items()]
    made: dict[str, str] = {}
    for position, (label, digest) in enumerate(listed):
        # Files of one name in several folders are numbered in the order of families, or in the command's.
        count = sum(each == label for each, _ in listed[:position])
        made[f"{label} ({count + 1})" if count else label] = digest
    return made


def read_manifest(folder: Path) -> Manifest:
    """Read a folder's manifest; raise `ManifestError` if it is missing, is no manifest, or was changed by hand."""
    # a JSON object ...
    path = folder / NAME
    try:
        # A pipe or a device might never end.
        if not path.is_file() and path.exists():
            raise ManifestError(f"{NAME}: is no plain file")
        check_limit("manifest_bytes", path.stat().st_size, NAME, "bytes")
        content = json.loads(path.read_bytes())
    except InputError as error:
        raise ManifestError(str(error)) from None
    except FileNotFoundError:
        raise ManifestError(f"{NAME}: missing") from None
    except OSError as error:
        raise ManifestError(f"{NAME}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise ManifestError(f"{NAME}: is no JSON") from None
    # ... of this form, that nobody has changed
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ManifestError(f"{NAME}: is no manifest of the form {FORMAT!r}")
    if content.pop("digest", None) != _digest(content):
        raise ManifestError(f"{NAME}: was changed; its digest does not fit")
    try:
        return validate(Manifest, {key: value for key, value in content.items() if key in Manifest.model_fields}, NAME)
    except InputError as error:
        raise ManifestError(str(error)) from None


def _digest(content: Any) -> str:
    """Return the hash of the manifest's content: changes by hand show."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def check_same(folder: Path, there: Manifest, wanted: Manifest) -> None:
    """Raise `InputError` if a folder holds another dataset, or the same one made by other code."""
    for what, old, new in (("dataset", there.dataset, wanted.dataset), ("origin", there.origin, wanted.origin)):
        difference = _first_difference(old, new)
        if difference is None:
            continue
        key, before, after = difference
        why = "another dataset" if what == "dataset" else "the same dataset, made by other versions"
        raise InputError(f"--out {folder}: holds {why} ({key} = {before} there, {after} here); must be another folder")


def _first_difference(old: Any, new: Any, path: str = "") -> tuple[str, Any, Any] | None:
    """Return key path and both values of the first difference of nested tables and lists; None if they are equal."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            found = _first_difference(old.get(key), new.get(key), f"{path}.{key}" if path else key)
            if found:
                return found
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, pair in enumerate(zip(old, new, strict=True)):
            found = _first_difference(*pair, f"{path}.{i}")
            if found:
                return found
        return None
    return None if old == new else (path, old, new)


def file_entry(path: Path) -> FileEntry:
    """Describe a finished file."""
    return FileEntry(bytes=path.stat().st_size, sha256=provenance.file_hash(path))
