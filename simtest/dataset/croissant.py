"""Croissant metadata of a dataset: JSON-LD that machine-learning catalogues and loaders read (MLCommons, 1.0)."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.dataset.fields import FIELDS, Field
from simtest.dataset.index import SAMPLES, TABLES, table_columns
from simtest.dataset.manifest import FileEntry, Manifest
from simtest.dataset.plan import Plan
from simtest.runtime.files import write_atomically

CROISSANT = "croissant.json"

_TERMS = (
    "citeAs", "column", "equivalentProperty", "extract", "field", "fileProperty", "fileObject", "fileSet", "format",
    "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex",
    "repeated", "replace", "samplingRate", "separator", "source", "subField", "transform",
)  # fmt: skip
"""Terms of the vocabulary ``cr``."""

_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _TERMS},
}

_KINDS = {"Int64": "sc:Integer", "Float64": "sc:Float", "String": "sc:Text", "Boolean": "sc:Boolean"}
"""Data type of schema.org by that of a table's column."""

_ABOUT = {
    TABLES[0]: "A row for each sample: its shard, the offset and length of its bytes there, and what it shows.",
    TABLES[1]: "A row for each true highlight; camera frame, mm.",
    TABLES[2]: "A row for each estimate of a built-in method at a detection or a missed highlight.",
}


def write_croissant(plan: Plan, manifest: Manifest, tables: Mapping[str, FileEntry], folder: Path) -> None:
    """Write the metadata; `tables` are the finished tables by name."""
    text = make_croissant(plan, manifest, tables)
    write_atomically(folder / CROISSANT, lambda part: part.write_text(text, encoding="utf-8"))


def make_croissant(plan: Plan, manifest: Manifest, tables: Mapping[str, FileEntry]) -> str:
    """Return the metadata as JSON, which depends on the dataset alone.

    Licence, creator, address and date of publication are left to whoever publishes the dataset.
    """
    dataset, made_by = plan.dataset, manifest.origin["versions"]["simtest"]
    shards = [_file(name, manifest.shards[name], "application/x-tar") for name in sorted(manifest.shards)]
    fields = [field for field in FIELDS if field.name not in plan.fields_left_out]
    content = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.name,
        "description": f"{dataset.description or dataset.title or dataset.name} Rendered by simtest {made_by}.",
        "version": "1.0.0",
        "keywords": ["endoscopy", "specular highlights", "surface normals", "depth", "synthetic"],
        "distribution": [
            *shards,
            *(_file(name, tables[name], "application/x-parquet") for name in TABLES),
            *(_members(field, [shard["@id"] for shard in shards]) for field in fields),
        ],
        "recordSet": [*(_rows(name, columns) for name, columns in table_columns(plan).items()), *map(_images, fields)],
    }
    return json.dumps(content, indent=1) + "\n"


def _file(name: str, entry: FileEntry, form: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{entry.bytes} B",
        "encodingFormat": form,
        "sha256": entry.sha256,
    }


def _members(field: Field, shards: list[str]) -> dict[str, Any]:
    """Describe one field's members of all shards."""
    return {
        "@type": "cr:FileSet",
        "@id": _set_name(field),
        "name": _set_name(field),
        "containedIn": [{"@id": shard} for shard in shards],
        "encodingFormat": "image/png" if field.suffix.endswith("png") else "application/octet-stream",
        "includes": f"*.{field.suffix}",
    }


def _set_name(field: Field) -> str:
    return f"{field.name}-files"


def _rows(name: str, columns: Mapping[str, str]) -> dict[str, Any]:
    """Describe a table."""
    table = name.removesuffix(".parquet")
    return {
        "@type": "cr:RecordSet",
        "@id": table,
        "name": table,
        "description": _ABOUT[name],
        **({"key": {"@id": f"{table}/key"}} if name == SAMPLES else {}),
        "field": [
            _field(f"{table}/{column}", _KINDS[kind], {"fileObject": {"@id": name}, "extract": {"column": column}})
            for column, kind in columns.items()
        ],
    }


def _images(field: Field) -> dict[str, Any]:
    """Describe the images of one field, each with the key of its sample."""
    files = {"fileSet": {"@id": _set_name(field)}}
    # Readers differ in how much of a member's ending belongs to its name.
    name = {**files, "extract": {"fileProperty": "filename"}, "transform": {"regex": r"^(\d+)"}}
    # The encoding says how counts become values, so a loader takes the bytes.
    kind = "sc:ImageObject" if field.name == "image" else "sc:Text"
    property_ = "content" if field.name == "image" else "fullpath"
    return {
        "@type": "cr:RecordSet",
        "@id": field.name,
        "name": field.name,
        "description": f"{field.meaning} ({field.dtype}, {field.shape}, unit: {field.unit}). {field.encoding}.",
        "field": [
            {**_field(f"{field.name}/key", "sc:Text", name), "references": {"field": {"@id": "index/key"}}},
            _field(f"{field.name}/{property_}", kind, {**files, "extract": {"fileProperty": property_}}),
        ],
    }


def _field(identity: str, kind: str, source: dict[str, Any]) -> dict[str, Any]:
    name = identity.rpartition("/")[2]
    return {"@type": "cr:Field", "@id": identity, "name": name, "dataType": kind, "source": source}
