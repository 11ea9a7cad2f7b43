"""Writes a dataset: shard by shard, never half of one under its final name, and goes on after any stop."""

import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO

from simtest.dataset.card import CARD, write_card
from simtest.dataset.index import TABLES, write_tables
from simtest.dataset.manifest import (
    NAME,
    FileEntry,
    Manifest,
    ManifestError,
    check_same,
    file_entry,
    new_manifest,
    read_manifest,
)
from simtest.dataset.plan import Plan, Shard
from simtest.dataset.sample import DEFAULT_VARIANT, Maker, Sample
from simtest.dataset.shard import finish, locked, whole_samples, write_sample
from simtest.errors import InputError
from simtest.runtime.engines import Engine, Tell
from simtest.runtime.files import make_folder
from simtest.runtime.resources import shown
from simtest.spec.dataset_recipe import Dataset
from simtest.validation.runner import Progress

PART = ".part"

SHARDS_PER_PROCESS = 8
"""A process is renewed after so many, since rebuilding scenes in a loop grows memory."""


@dataclass(frozen=True)
class ShardTask:
    """What a worker needs to write a shard.

    Parameters
    ----------
    folder : str
        The dataset's.
    dataset : str
        The specification, as JSON.
    number : int
        Which of the plan's shards.
    variant : str
        Mitsuba variant.
    """

    folder: str
    dataset: str
    number: int
    variant: str


def write_dataset(
    dataset: Dataset, folder: Path, engine: Engine, variant: str | None = None, progress: Progress | None = None
) -> Manifest:
    """Write a dataset, or go on with one that was stopped.

    Parameters
    ----------
    dataset : Dataset
        What is wanted.
    folder : Path
        Made if need be; must hold nothing, or the same dataset made by the same code.
    engine : Engine
        Who does the work.
    variant : str, optional
        Mitsuba variant, of colour.
    progress : callable, optional
        Told of samples done, samples in all, and what is done.

    Returns
    -------
    Manifest

    Raises
    ------
    InputError
        If the dataset cannot be made as it is described, or the folder holds something else or cannot be written.
    """
    plan = Plan(dataset)
    with _spoken(folder):
        manifest = _open(folder, plan, variant or DEFAULT_VARIANT)
        _complete(plan, manifest, folder, engine, progress)
    return manifest


def _complete(plan: Plan, manifest: Manifest, folder: Path, engine: Engine, progress: Progress | None) -> None:
    """Write what a manifest lacks: shards, then tables and card."""
    missing = [number for number, shard in enumerate(plan.shards) if shard.name not in manifest.shards]
    variant, text = str(manifest.origin["variant"]), plan.dataset.model_dump_json()
    tasks = [ShardTask(str(folder), text, number, variant) for number in missing]
    total = plan.dataset.samples
    done = total - sum(len(plan.shards[number].indices) for number in missing)

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(min(done, total), total + 1, f"{manifest.dataset['name']}: samples")

    if tasks:
        # Tables of a dataset that was whole before say too much now.
        manifest.tables = {}
        manifest.save(folder)
    for place, entry in engine.run(write_shard, tasks, step):
        manifest.shards[plan.shards[missing[place]].name] = entry
        manifest.save(folder)
    if not manifest.tables or not all((folder / name).exists() for name in manifest.tables):
        if progress:
            progress(total, total + 1, "tables")
        write_tables(plan, folder)
        write_card(plan, manifest, folder)
        manifest.tables = {name: file_entry(folder / name) for name in (*TABLES, CARD)}
        manifest.save(folder)
    for left in folder.glob(f"*{PART}*"):
        left.unlink(missing_ok=True)


def repair(folder: Path, manifest: Manifest, broken: list[str], engine: Engine, progress: Progress | None) -> None:
    """Make named files of a dataset again: shards, tables or card."""
    plan = manifest.plan()
    with _spoken(folder):
        for name in broken:
            (folder / name).unlink(missing_ok=True)
            manifest.shards.pop(name, None)
        manifest.tables = {}
        manifest.save(folder)
        _complete(plan, manifest, folder, engine, progress)


@contextmanager
def _spoken(folder: Path) -> Iterator[None]:
    """Turn what the operating system says into one line."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"--out {shown(folder)}: cannot be written ({error.strerror}); what is written stays valid, and the same "
            "command goes on from there"
        ) from error


def _open(folder: Path, plan: Plan, variant: str) -> Manifest:
    make_folder(folder)
    wanted = new_manifest(plan, variant)
    try:
        there = read_manifest(folder)
    except ManifestError as error:
        if (folder / NAME).exists():
            raise InputError(
                f"--out {shown(folder)}: {error}; must be another folder, or simtest dataset verify"
            ) from None
        if other := next((path.name for path in folder.iterdir() if not path.name.endswith(PART)), None):
            raise InputError(
                f"--out {shown(folder)}: holds {shown(other)} and no dataset; must be empty or not exist"
            ) from None
        wanted.save(folder)
        return wanted
    check_same(folder, there, wanted)
    for name in [name for name in there.shards if not (folder / name).exists()]:
        del there.shards[name]
    return there


# In a worker --------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _maker(dataset: str, variant: str) -> Maker:
    # A process that writes several shards keeps its rendering session.
    return Maker(Plan(Dataset.model_validate_json(dataset)), variant)


def write_shard(task: ShardTask, tell: Tell) -> FileEntry:
    """Write a shard, or finish one that was begun.

    Parameters
    ----------
    task : ShardTask
        Which.
    tell : callable
        Told of each sample.

    Returns
    -------
    FileEntry
    """
    folder, maker = Path(task.folder), _maker(task.dataset, task.variant)
    with _spoken(folder):
        return _write_shard(folder, maker, maker.plan.shards[task.number], tell)


def _write_shard(folder: Path, maker: Maker, shard: Shard, tell: Tell) -> FileEntry:
    path = folder / shard.name
    part = folder / (shard.name + PART)
    if path.exists() and _is_whole(path, shard):
        for _ in shard.indices:
            tell()
        return file_entry(path)
    with locked(part) as file:
        count = _go_on(file, shard)
        for _ in range(count):
            tell()
        append(file, maker, shard.indices[count:], tell)
        finish(file)
        file.flush()
        os.fsync(file.fileno())
        os.replace(part, path)
    _sync(folder)
    return file_entry(path)


def _is_whole(path: Path, shard: Shard) -> bool:
    """Tell whether a shard that the manifest does not know yet is finished."""
    with path.open("rb") as file:
        found, whole = whole_samples(file)
    return whole and tuple(sample.meta.get("index") for sample in found) == shard.indices


def _go_on(file: IO[bytes], shard: Shard) -> int:
    """Cut a begun shard after its last whole sample; give the number of samples kept."""
    found, _ = whole_samples(file)
    end, count = 0, 0
    for sample, index in zip(found, shard.indices, strict=False):
        if sample.meta.get("index") != index:
            break
        end, count = sample.end, count + 1
    file.truncate(end)
    file.seek(end)
    return count


def append(file: IO[bytes], maker: Maker, indices: tuple[int, ...], tell: Tell) -> None:
    """Make samples; each is encoded and written while the next is rendered."""
    with ThreadPoolExecutor(1) as writer:
        before: Future[None] | None = None
        for index in indices:
            sample = maker.make(index)
            if before is not None:
                before.result()
                tell()
            before = writer.submit(_write, file, sample)
        if before is not None:
            before.result()
            tell()


def _write(file: IO[bytes], sample: Sample) -> None:
    write_sample(file, sample.key, sample.encode())
    file.flush()


def _sync(folder: Path) -> None:
    """Flush a folder's entries to disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
