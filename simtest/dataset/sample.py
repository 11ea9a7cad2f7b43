"""A sample in memory, and its encoding as the members of a shard."""

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

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
