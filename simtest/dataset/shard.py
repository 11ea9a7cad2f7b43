"""Samples in memory, and shards of them: tar files whose writing can stop anywhere and be continued.

A sample is whole if its last member, the metadata, is there and the hashes that it holds are those of the others. So a
shard that was stopped in the middle needs no journal: it is cut after its last whole sample.
"""

import hashlib
import json
import os
import tarfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO

from simtest.dataset.fields import BY_SUFFIX, FIELDS
from simtest.dataset.metadata import SampleMeta
from simtest.runtime.arrays import AnyArray


@dataclass(frozen=True)
class Sample:
    """A sample: its metadata, written as JSON, and its decoded images by field name."""

    meta: SampleMeta
    images: dict[str, AnyArray]

    @property
    def index(self) -> int:
        """Number of the sample in the dataset, from 0."""
        return self.meta["index"]

    @property
    def key(self) -> str:
        """Name of the sample in its shard."""
        return self.meta["key"]

    def encode(self) -> dict[str, bytes]:
        """Return the shard's members by suffix, the metadata last, with the hashes of the others."""
        fields = [field for field in FIELDS if field.name in self.images]
        # The codecs release Python's lock, so two threads nearly halve the time.
        with ThreadPoolExecutor(2) as threads:
            encoded = threads.map(lambda field: field.codec.encode(self.images[field.name]), fields)
            members = {field.suffix: data for field, data in zip(fields, encoded, strict=True)}
        hashes = {suffix: hashlib.sha256(data).hexdigest() for suffix, data in members.items()}
        text = json.dumps({**self.meta, "sha256": hashes}, allow_nan=False, separators=(",", ":"))
        return {**members, "json": text.encode()}


def decode(members: Mapping[str, bytes], meta: SampleMeta) -> Sample:
    """Decode a sample's images from the members of a shard, given by suffix."""
    images = {BY_SUFFIX[s].name: BY_SUFFIX[s].codec.decode(data, meta) for s, data in members.items() if s in BY_SUFFIX}
    return Sample(meta, images)


def sample_key(index: int) -> str:
    """Return the name of a sample in its shard."""
    return f"{index:09d}"


PART = ".part"
"""End of the name of a file that is not finished, or that serves to make another."""

BLOCK = tarfile.BLOCKSIZE
MAX_MEMBER_BYTES = 1 << 31


@dataclass(frozen=True)
class StoredSample:
    """A sample in a shard: its key, offset and size of each member by suffix, the offset after it, and its metadata."""

    key: str
    members: dict[str, tuple[int, int]]
    end: int
    meta: SampleMeta


class BrokenShardError(Exception):
    """A shard cannot be read; the text says where and why."""


def write_sample(file: IO[bytes], key: str, members: dict[str, bytes]) -> None:
    """Append a sample; the headers hold neither time nor owner nor machine."""
    for suffix, data in members.items():
        header = tarfile.TarInfo(f"{key}.{suffix}")
        header.size = len(data)
        file.write(header.tobuf(tarfile.USTAR_FORMAT))
        file.write(data)
        file.write(bytes(-len(data) % BLOCK))


def finish(file: IO[bytes]) -> None:
    """Write the end of the archive: two empty blocks, padded to a record."""
    file.write(bytes(2 * BLOCK))
    file.write(bytes(-file.tell() % tarfile.RECORDSIZE))


def samples(file: IO[bytes], check: bool = True, offset: int = 0) -> Iterator[StoredSample]:
    """Read the samples of a shard from a file, from the one at an offset, bytes, on.

    With `check` all members are read and their hashes compared; without, the metadata alone are read.

    Raises
    ------
    BrokenShardError
        At the first thing that is neither a whole sample nor the end of the archive.
    """
    size = os.fstat(file.fileno()).st_size
    # Key and members of the sample that is being read; its metadata end it.
    current, members = "", dict[str, tuple[int, int]]()
    while True:
        file.seek(offset)
        block = file.read(BLOCK)
        if block == bytes(BLOCK):
            if members:
                raise BrokenShardError(f"sample {current} ends without metadata")
            _check_end(file, offset, size)
            return
        name, length = _header(block, offset)
        key, _, suffix = name.partition(".")
        start = offset + BLOCK
        offset = start + length + -length % BLOCK
        if offset > size:
            raise BrokenShardError(f"{name} is cut short")
        if members and key != current:
            raise BrokenShardError(f"{name} stands inside sample {current}")
        if suffix in members:
            raise BrokenShardError(f"{name} is there twice")
        current, members[suffix] = key, (start, length)
        if suffix == "json":
            sample = StoredSample(key, members, offset, _meta(file, name, start, length))
            if check:
                _check_hashes(file, sample)
            yield sample
            members = {}


def _header(block: bytes, offset: int) -> tuple[str, int]:
    """Return name and size of the member whose header is a block."""
    if len(block) < BLOCK:
        raise BrokenShardError(f"ends at byte {offset + len(block)} without the archive's end")
    try:
        header = tarfile.TarInfo.frombuf(block, "ascii", "strict")
    except (tarfile.HeaderError, UnicodeDecodeError) as error:
        raise BrokenShardError(f"no tar header at byte {offset} ({error})") from None
    if not header.isreg() or not 0 <= header.size < MAX_MEMBER_BYTES:
        raise BrokenShardError(f"{header.name!r} at byte {offset} is no plain member")
    return header.name, header.size


def _meta(file: IO[bytes], name: str, start: int, length: int) -> SampleMeta:
    file.seek(start)
    try:
        meta: SampleMeta = json.loads(file.read(length))
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise BrokenShardError(f"{name} is no JSON") from None
    if not isinstance(meta, dict) or not isinstance(meta.get("sha256"), dict):
        raise BrokenShardError(f"{name} holds no hashes")
    return meta


def _check_hashes(file: IO[bytes], sample: StoredSample) -> None:
    wanted = sample.meta["sha256"]
    if set(wanted) | {"json"} != set(sample.members):
        raise BrokenShardError(f"sample {sample.key} has other members than its metadata says")
    for suffix, digest in wanted.items():
        start, length = sample.members[suffix]
        file.seek(start)
        if hashlib.sha256(file.read(length)).hexdigest() != digest:
            raise BrokenShardError(f"{sample.key}.{suffix} differs from its hash")


def _check_end(file: IO[bytes], offset: int, size: int) -> None:
    file.seek(offset)
    if any(file.read()):
        raise BrokenShardError(f"something follows the archive's end at byte {offset}")
    if size % tarfile.RECORDSIZE or size - offset < 2 * BLOCK:
        raise BrokenShardError("the archive's end is cut short")


def whole_samples(file: IO[bytes]) -> tuple[list[StoredSample], bool]:
    """Return the whole samples at a shard's beginning, and whether the shard is whole."""
    found: list[StoredSample] = []
    try:
        for sample in samples(file):
            found.append(sample)
    except BrokenShardError:
        return found, False
    return found, True


def read_member(file: IO[bytes], sample: StoredSample, suffix: str) -> bytes:
    """Return the bytes of a sample's member."""
    start, length = sample.members[suffix]
    file.seek(start)
    return file.read(length)
