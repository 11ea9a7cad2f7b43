"""Reads datasets as NumPy records."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from simtest.dataset.fields import BASE_FIELDS, BY_NAME, FINE_OF, INSTRUMENT, Field, no_instrument, smooth_base
from simtest.dataset.manifest import Manifest, ManifestError, read_manifest
from simtest.dataset.sample import Sample
from simtest.dataset.shard import BrokenShardError, StoredSample, read_member, samples
from simtest.errors import InputError
from simtest.runtime.arrays import AnyArray
from simtest.runtime.files import require_plain
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
        Array by field name (units and frames in the card), and ``meta``: the sample's metadata. Where there is no
        relief, ``normal_base`` and ``curvature_base`` are the arrays ``normal`` and ``curvature``, and ``pool`` is
        false. Where the scene lists no instruments, ``instrument`` is 0.

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
    wanted = list(BY_NAME) if fields is None else list(fields)
    for name in wanted:
        if name not in BY_NAME:
            raise InputError(f"field {shown(name)}: unknown; allowed: {', '.join(BY_NAME)}")
    names = list(shards) if shards is not None else shard_names(folder, split)
    return _read_shards(folder, names, wanted, indices, required=fields is not None)


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


def _read_shards(
    folder: Path, names: list[str], fields: list[str], indices: Collection[int] | None, required: bool
) -> Iterator[Sample]:
    for name in names:
        try:
            with require_plain(folder / name).open("rb") as file:
                for stored in samples(file, check=False):
                    if indices is not None and stored.meta["index"] not in indices:
                        continue
                    sample = Sample(stored.meta, {})
                    for field in (BY_NAME[n] for n in fields):
                        image = _image(file, stored, field, sample.images)
                        if image is not None:
                            sample.images[field.name] = image
                        elif required:
                            raise InputError(f"{name}: sample {stored.key} has no {field.name}")
                    yield sample
        except OSError as error:
            raise InputError(f"{folder / name}: cannot be read ({error.strerror})") from error
        except (BrokenShardError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{folder / name}: {error}; simtest dataset verify --repair mends it") from error


def _image(file: IO[bytes], stored: StoredSample, field: Field, read_before: dict[str, AnyArray]) -> AnyArray | None:
    """Decode a field; None where the sample has none. `read_before` holds the sample's other fields, by name."""
    if field.suffix in stored.members:
        return field.decode(read_member(file, stored, field.suffix), stored.meta)
    if field.name == INSTRUMENT:
        return no_instrument(stored.meta)
    if field.name not in BASE_FIELDS:
        return None
    # On a smooth surface the base is the fine surface.
    twin = FINE_OF.get(field.name)
    fine = read_before.get(twin) if twin else None
    if twin and fine is None:
        fine = _image(file, stored, BY_NAME[twin], read_before)
    return smooth_base(field.name, fine, stored.meta)
