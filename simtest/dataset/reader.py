"""Reads datasets as NumPy records."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from simtest.dataset.fields import BY_NAME, Field
from simtest.dataset.manifest import Manifest, ManifestError, read_manifest
from simtest.dataset.shard import BrokenShardError, Sample, StoredSample, read_member, samples
from simtest.errors import InputError
from simtest.runtime.arrays import AnyArray
from simtest.runtime.files import require_plain

if TYPE_CHECKING:
    import polars as pl

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
        Array by field name (units and frames in the card), and ``meta``: the sample's metadata. Where there is no
        relief, ``normal_base`` and ``curvature_base`` are the arrays ``normal`` and ``curvature``, and ``pool`` is
        false. Where nothing of theirs is stored, ``instrument``, ``polyp`` and ``covering`` are 0.

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
    indices: Collection[int] | None = None,
) -> Iterator[Sample]:
    """Read a dataset as `read` does, but as typed samples; of all samples, or of those with given indices."""
    folder = Path(folder)
    wanted = _known_fields(fields)
    names = list(shards) if shards is not None else shard_names(folder, split)
    return _read_shards(folder, names, wanted, indices, required=fields is not None)


def open_manifest(folder: Path) -> Manifest:
    """Read a dataset's manifest; raise `InputError` if there is none that can be used."""
    try:
        return read_manifest(folder)
    except ManifestError as error:
        raise InputError(f"{folder}: no dataset to read ({error})") from None


def shard_names(folder: Path, split: str | None = None) -> list[str]:
    """Return the names of a finished dataset's shards, of one split or of all."""
    manifest = open_manifest(folder)
    if not manifest.complete:
        raise InputError(f"{folder}: the dataset is not finished; give its simtest dataset command again")
    splits = sorted({name.rpartition("-")[0] for name in manifest.shards})
    if split is not None and split not in splits:
        raise InputError(f"split = {split}: unknown; allowed: {', '.join(splits)}")
    return [name for name in sorted(manifest.shards) if split in (None, name.rpartition("-")[0])]


def read_table(path: Path, columns: list[str] | None = None) -> "pl.DataFrame":
    """Read a table of a dataset, or some of its columns; raise `InputError` where it is missing or damaged."""
    # Here alone: polars takes 0.1 s to import, and who reads shard after shard needs none.
    import polars as pl

    try:
        return pl.read_parquet(require_plain(path), columns=columns)
    except (OSError, ValueError, pl.exceptions.PolarsError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read ({reason}); simtest dataset verify --repair mends it") from None


@dataclass(frozen=True)
class SamplePosition:
    """Where a sample stands: file name of its shard, and offset of its first byte there."""

    shard: str
    offset: int


def sample_positions(folder: str | Path, split: str | None = None) -> list[SamplePosition]:
    """Return where the samples of a split stand, shard after shard; raise errors as `read` does."""
    folder = Path(folder)
    wanted = set(shard_names(folder, split))
    from simtest.dataset.index import SAMPLES

    rows = sorted(read_table(folder / SAMPLES, ["shard", "offset"]).iter_rows())
    return [SamplePosition(shard, offset) for shard, offset in rows if shard in wanted]


def read_at(
    folder: str | Path, positions: Iterable[SamplePosition], fields: Sequence[str] | None = None
) -> Iterator[Record]:
    """Read samples at known positions, in that order, as `read` does; a shard is opened once for neighbours in it."""
    fields_read = _known_fields(fields)
    return _read_at(Path(folder), positions, fields_read, required=fields is not None)


def _read_at(folder: Path, positions: Iterable[SamplePosition], fields: list[str], required: bool) -> Iterator[Record]:
    for name, together in groupby(positions, key=lambda position: position.shard):
        with _one_line_errors(folder / name), require_plain(folder / name).open("rb") as file:
            for position in together:
                if position.offset < 0:
                    raise BrokenShardError(f"offset {position.offset} is negative")
                stored = next(samples(file, check=False, offset=position.offset), None)
                if stored is None:
                    raise BrokenShardError(f"no sample at byte {position.offset}")
                sample = _decoded(file, name, stored, fields, required)
                yield {"meta": sample.meta, **sample.images}


def _known_fields(fields: Sequence[str] | None) -> list[str]:
    """Return names of fields, by default all; raise `InputError` if one is unknown."""
    wanted = list(BY_NAME) if fields is None else list(fields)
    for name in wanted:
        if name not in BY_NAME:
            raise InputError(f"field {name}: unknown; allowed: {', '.join(BY_NAME)}")
    return wanted


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    """Turn what goes wrong with a shard into an error of one line."""
    try:
        yield
    except (BrokenShardError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: {error}; simtest dataset verify --repair mends it") from error


def _read_shards(
    folder: Path, names: list[str], fields: list[str], indices: Collection[int] | None, required: bool
) -> Iterator[Sample]:
    for name in names:
        with _one_line_errors(folder / name), require_plain(folder / name).open("rb") as file:
            for stored in samples(file, check=False):
                if indices is None or stored.meta["index"] in indices:
                    yield _decoded(file, name, stored, fields, required)


def _decoded(file: IO[bytes], shard: str, stored: StoredSample, fields: list[str], required: bool) -> Sample:
    """Decode fields of a sample; raise `InputError` where it lacks one that is required."""
    sample = Sample(stored.meta, {})
    for field in (BY_NAME[name] for name in fields):
        image = _image(file, stored, field, sample.images)
        if image is not None:
            sample.images[field.name] = image
        elif required:
            raise InputError(f"{shard}: sample {stored.key} has no {field.name}")
    return sample


def _image(file: IO[bytes], stored: StoredSample, field: Field, read_before: dict[str, AnyArray]) -> AnyArray | None:
    """Decode a field; None where the sample has none. `read_before` holds the sample's other fields, by name."""
    if field.suffix in stored.members:
        return field.codec.decode(read_member(file, stored, field.suffix), stored.meta)
    if field.otherwise is None or field.is_required(stored.meta):
        return None
    if isinstance(field.otherwise, str):
        # One array under two names.
        twin = BY_NAME[field.otherwise]
        return read_before[twin.name] if twin.name in read_before else _image(file, stored, twin, read_before)
    camera = stored.meta["camera"]
    return np.full((camera["height"], camera["width"]), field.otherwise, field.dtype)
