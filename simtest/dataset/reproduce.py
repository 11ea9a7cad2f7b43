"""Reproduces one sample of a dataset alone, and compares it with the stored one."""

from pathlib import Path

from simtest.dataset.maker import Maker
from simtest.dataset.reader import open_manifest
from simtest.dataset.sample import sample_key
from simtest.dataset.shard import BrokenShardError, read_member, samples
from simtest.errors import InputError
from simtest.runtime.locks import exclusive_folder


def reproduce_sample(folder: Path, index: int, out: Path, variant: str | None = None) -> list[Path]:
    """Make a sample anew and write its members as files into a folder, created if needed; return their paths.

    By default the dataset's Mitsuba variant renders it. Raises `InputError` if there is no such sample, or the folder
    cannot be written; `SimtestError` if its disk is full.
    """
    manifest = open_manifest(folder)
    plan = manifest.plan()
    if not 0 <= index < plan.dataset.samples:
        raise InputError(f"INDEX = {index}: must be 0 to {plan.dataset.samples - 1}")
    files = []
    with exclusive_folder(out):
        made = Maker(plan, variant or manifest.origin["variant"]).make(index)
        for suffix, data in made.encode().items():
            files.append(out / f"{made.key}.{suffix}")
            files[-1].write_bytes(data)
    return files


def compare(folder: Path, index: int, out: Path) -> str:
    """Compare the files that `reproduce_sample` wrote with the stored sample; return one line."""
    shard, key = open_manifest(folder).plan().shard_of(index), sample_key(index)
    try:
        with (folder / shard.name).open("rb") as file:
            # Only the metadata are read until the sample is found.
            stored = next((sample for sample in samples(file, check=False) if sample.key == key), None)
            if stored is None:
                return f"{shard.name} holds no sample {key}"
            different = [s for s in stored.members if read_member(file, stored, s) != _bytes(out / f"{key}.{s}")]
    except (OSError, BrokenShardError) as error:
        return f"{shard.name}: cannot be compared ({error})"
    return f"{shard.name}: differs in {', '.join(different)}" if different else f"{shard.name}: same bytes"


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None
