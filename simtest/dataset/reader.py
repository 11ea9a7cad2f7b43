"""Reads datasets as NumPy records."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from simtest.dataset.fields import BY_NAME
from simtest.dataset.manifest import Manifest, ManifestError, read_manifest
from simtest.dataset.sample import Sample
from simtest.dataset.shard import BrokenShardError, read_member, samples
from simtest.errors import InputError
from simtest.runtime.resources import shown

Record = dict[str, Any]
"""A sample as `read` yields it: array by field name, and ``meta``, a `SampleMeta`."""


def read(
    folder: str | Path,
    split: str | None = None,
    fields: Sequence[str] | None = None,
    shards: Sequence[str] | None = None,
) -> Iterator[Record]:
    """Read a dataset, one sample after the other.

    Parameters
    ----------
    folder : str or Path
        The dataset's.
    split : str, optional
        train, validation or test; default all.
    fields : sequence of str, optional
        Which images to decode (see the card, or `simtest.dataset.FIELDS`); default all there are.
    shards : sequence of str, optional
        File names, instead of all shards of the split.

    Yields
    ------
    dict
        Array by field name (units and frames in the card), and ``meta``: the sample's metadata.

    Raises
    ------
    InputError
        If the folder holds no finished dataset, or there is no such split, field or shard.
    """
    # Not a generator itself, so that wrong arguments raise at the call.
    return ({"meta": sample.meta, **sample.images} for sample in read_samples(folder, split, fields, shards))


def read_samples(
    folder: str | Path,
    split: str | None = None,
    fields: Sequence[str] | None = None,
    shards: Sequence[str] | None = None,
) -> Iterator[Sample]:
    """Read a dataset as `read` does, but as typed samples."""
    folder = Path(folder)
    wanted = list(BY_NAME) if fields is None else list(fields)
    for name in wanted:
        if name not in BY_NAME:
            raise InputError(f"field {shown(name)}: unknown; allowed: {', '.join(BY_NAME)}")
    names = list(shards) if shards is not None else shard_names(folder, split)
    return _read_shards(folder, names, wanted, required=fields is not None)


def open_manifest(folder: Path) -> Manifest:
    """Read a dataset's manifest; raise `InputError` if there is none that can be used."""
    try:
        return read_manifest(folder)
    except ManifestError as error:
        raise InputError(f"{shown(folder)}: no dataset to read ({error})") from None


def shard_names(folder: Path, split: str | None = None) -> list[str]:
    """Return the names of a finished dataset's shards, of one split or of all."""
    manifest = open_manifest(folder)
    if not manifest.tables:
        raise InputError(f"{shown(folder)}: the dataset is not finished; give its simtest dataset command again")
    splits = sorted({name.rpartition("-")[0] for name in manifest.shards})
    if split is not None and split not in splits:
        raise InputError(f"split = {shown(split)}: unknown; allowed: {', '.join(splits)}")
    return [name for name in sorted(manifest.shards) if split in (None, name.rpartition("-")[0])]


def _read_shards(folder: Path, names: list[str], fields: list[str], required: bool) -> Iterator[Sample]:
    for name in names:
        try:
            with (folder / name).open("rb") as file:
                for stored in samples(file, check=False):
                    sample = Sample(stored.meta, {})
                    for field in (BY_NAME[n] for n in fields):
                        if field.suffix in stored.members:
                            data = read_member(file, stored, field.suffix)
                            sample.images[field.name] = field.decode(data, stored.meta)
                        elif required:
                            raise InputError(f"{name}: sample {stored.key} has no {field.name}")
                    yield sample
        except OSError as error:
            raise InputError(f"{folder / name}: cannot be read ({error.strerror})") from error
        except (BrokenShardError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{folder / name}: {error}; simtest dataset verify --repair mends it") from error
