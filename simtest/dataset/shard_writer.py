"""Writes a dataset shard by shard: never half of one under its final name, and continued after any interruption."""

import errno
import os
import warnings
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO

from simtest.dataset.card import CARD, write_card
from simtest.dataset.index import FOLDERS, SAMPLES, shard_files, shortfall, write_index, write_shard_tables
from simtest.dataset.maker import Maker
from simtest.dataset.manifest import (
    NAME,
    Files,
    Manifest,
    ManifestError,
    check_same,
    file_entry,
    new_manifest,
    read_manifest,
)
from simtest.dataset.plan import Plan, Shard
from simtest.dataset.shard import PART, Sample, finish, whole_samples, write_sample
from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.estimators.names import absolute_names
from simtest.rendering.backend import colour_variant
from simtest.runtime.boundary import plain
from simtest.runtime.files import sync_folder
from simtest.runtime.locks import LOCK, exclusive_folder, waiting_for
from simtest.runtime.processes import Engine, OnStep
from simtest.spec.recipes import Dataset
from simtest.validation.runner import Progress

SHARDS_PER_PROCESS = 8
"""After so many a process is replaced, since rebuilding scenes in a loop grows memory."""


UNSAVED_SHARE = 0.05
"""The manifest is written again when more than this share of its shards is new: a file of n shards for every one of n
would be quadratic. After a kill the shards that it lacks are read and entered; none is made again."""


@dataclass(frozen=True)
class ShardTask:
    """Argument of `write_shard`: folder, specification as JSON, index among the plan's shards, and Mitsuba variant."""

    folder: str
    dataset: str
    number: int
    variant: str


def write_dataset(
    dataset: Dataset, folder: Path, engine: Engine, variant: str | None = None, progress: Progress | None = None
) -> Manifest:
    """Write a dataset, or continue one that was interrupted.

    Parameters
    ----------
    dataset : Dataset
        The recipe.
    folder : Path
        Created if needed; must hold nothing, or the same dataset made by the same code.
    engine : Engine
        Runs the tasks.
    variant : str, optional
        Mitsuba variant, of colour.
    progress : callable, optional
        Called with samples done, samples in all, and what is being done.

    Warns
    -----
    UserWarning
        Of samples that show fewer isolated highlights than the recipe asks for, with their number and the reasons.
    """
    plan = Plan(dataset)
    if plan.made_small:
        warnings.warn(plan.made_small, stacklevel=2)
    # Refused before anything is written; who reads the dataset needs neither packages nor cores.
    load_estimators(dataset.estimators)
    with _telling_what_stays(folder), exclusive_folder(folder):
        manifest = _open(folder, plan, colour_variant(variant))
        few = _complete(plan, manifest, folder, engine, progress)
    if few:
        warnings.warn(few, stacklevel=2)
    return manifest


def _complete(plan: Plan, manifest: Manifest, folder: Path, engine: Engine, progress: Progress | None) -> str:
    """Write what a manifest lacks: shards with their rows, then index and card; return the `shortfall`."""
    # Shards that were removed, or some of their rows, are made anew.
    for shard in plan.shards:
        if shard.name in manifest.shards and not all((folder / name).exists() for name in shard_files(shard)):
            del manifest.shards[shard.name]
    # what is left to do
    missing = [number for number, shard in enumerate(plan.shards) if shard.name not in manifest.shards]
    # A worker, on another machine of a cluster for one, may have another current folder.
    estimators = absolute_names(plan.dataset.estimators)
    variant = str(manifest.origin["variant"])
    text = plan.dataset.model_copy(update={"estimators": estimators}).model_dump_json()
    tasks = [ShardTask(str(folder), text, number, variant) for number in missing]
    total = plan.dataset.samples
    done = total - sum(len(plan.shards[number].indices) for number in missing)

    def step(count: int = 1) -> None:
        nonlocal done
        done += count
        if progress:
            progress(min(done, total), total, f"{manifest.dataset['name']}: samples")

    # shards
    if tasks:
        manifest.complete = False
        manifest.save(folder)
        # The time left is measured from the end of the first sample on.
        step(0)
    _write_shards(plan, manifest, folder, engine.run(write_shard, tasks, step), missing)
    # index and card, of all shards
    unfinished = not manifest.complete or not all((folder / name).exists() for name in (SAMPLES, CARD))
    if unfinished:
        write_index(plan, folder)
    few = shortfall(plan, folder)
    if unfinished:
        write_card(plan, manifest, few, folder)
        manifest.tables |= {name: file_entry(folder / name) for name in (SAMPLES, CARD)}
        manifest.complete = True
        manifest.save(folder)
    # the index's rows of single shards, and parts of interrupted runs
    for held in (folder, *(folder / name for name in FOLDERS)):
        for left in held.glob(f"*{PART}*"):
            left.unlink(missing_ok=True)
    return few


def _write_shards(
    plan: Plan, manifest: Manifest, folder: Path, finished: Iterator[tuple[int, Files]], missing: list[int]
) -> None:
    """Enter shards into the manifest as they are finished; the manifest is saved whatever ends the run, but a kill."""
    unsaved = 0
    try:
        for task, files in finished:
            name = plan.shards[missing[task]].name
            manifest.shards[name] = files.pop(name)
            manifest.tables |= files
            unsaved += 1
            if unsaved > UNSAVED_SHARE * len(manifest.shards):
                manifest.save(folder)
                unsaved = 0
    finally:
        if unsaved:
            manifest.save(folder)


def remake(folder: Path, manifest: Manifest, broken: list[str], engine: Engine, progress: Progress | None) -> None:
    """Make named files of a dataset anew: shards, tables or card."""
    plan = manifest.plan()
    with _telling_what_stays(folder), exclusive_folder(folder, "DATASET"):
        for name in broken:
            (folder / name).unlink(missing_ok=True)
        manifest.complete = False
        manifest.save(folder)
        _complete(plan, manifest, folder, engine, progress)


@contextmanager
def _telling_what_stays(folder: Path) -> Iterator[None]:
    """Raise an error of the disk as one that says what stays of the work."""
    try:
        yield
    except OSError as error:
        raise plain(error, "what is written stays valid, and the same command goes on from there", folder) from error


def _open(folder: Path, plan: Plan, variant: str) -> Manifest:
    """Return the manifest of a folder that is empty, or holds the same dataset."""
    wanted = new_manifest(plan, variant)
    # A folder without a manifest must be empty, but for parts of a run that never finished a shard.
    try:
        there = read_manifest(folder)
    except ManifestError as error:
        if (folder / NAME).exists():
            raise InputError(f"--out {folder}: {error}; must be another folder, or simtest dataset verify") from None
        if other := next((path.name for path in folder.iterdir() if not path.name.endswith((PART, LOCK))), None):
            raise InputError(f"--out {folder}: holds {other} and no dataset; must be empty or not exist") from None
        wanted.save(folder)
        return wanted
    check_same(folder, there, wanted)
    # A file that was cut or changed since is not taken for a finished one.
    for name, entry in {**there.shards, **there.tables}.items():
        if name != CARD and (path := folder / name).exists() and (said := entry.wrong_size(path)):
            raise InputError(f"--out {folder}: {name} {said}; simtest dataset verify --repair mends it")
    return there


# In a worker --------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def maker_of(dataset: str, variant: str) -> Maker:
    """Return this process's maker of a dataset, given as JSON: it keeps its rendering session from shard to shard."""
    return Maker(Plan(Dataset.model_validate_json(dataset)), variant)


def write_shard(task: ShardTask, on_step: OnStep) -> Files:
    """Write a shard and its rows, or finish one that was begun; call `on_step` after each sample."""
    folder, maker = Path(task.folder), maker_of(task.dataset, task.variant)
    shard = maker.plan.shards[task.number]
    with _telling_what_stays(folder):
        _write_shard(folder, maker, shard, on_step)
        # Here, not at the end: one process would take hours for the tables of millions of samples.
        write_shard_tables(maker.plan, folder, shard)
        return {name: file_entry(folder / name) for name in shard_files(shard)}


def _write_shard(folder: Path, maker: Maker, shard: Shard, on_step: OnStep) -> None:
    path = folder / shard.name
    part = folder / (shard.name + PART)
    # finished, but not in the manifest: the run was killed in between
    if path.is_file() and _is_whole(path, shard):
        for _ in shard.indices:
            on_step()
        return
    # begun, or not yet
    # A writer whose parent was killed may live for another moment.
    with waiting_for(part) as file:
        if not file.writable():
            raise PermissionError(errno.EACCES, "is another user's, who has not finished it", str(part))
        count = _keep_whole(file, shard)
        for _ in range(count):
            on_step()
        append(file, maker, shard.indices[count:], on_step)
        finish(file)
        file.flush()
        os.fsync(file.fileno())
        os.replace(part, path)
    sync_folder(folder)


def _is_whole(path: Path, shard: Shard) -> bool:
    """Return whether a shard that the manifest does not list yet is finished."""
    with path.open("rb") as file:
        found, whole = whole_samples(file)
    return whole and tuple(sample.meta.get("index") for sample in found) == shard.indices


def _keep_whole(file: IO[bytes], shard: Shard) -> int:
    """Cut a begun shard after its last whole sample; return the number of samples kept."""
    found, _ = whole_samples(file)
    end, count = 0, 0
    for sample, index in zip(found, shard.indices, strict=False):
        if sample.meta.get("index") != index:
            break
        end, count = sample.end, count + 1
    file.truncate(end)
    file.seek(end)
    return count


def append(file: IO[bytes], maker: Maker, indices: tuple[int, ...], on_step: OnStep) -> None:
    """Make samples and append them; each is encoded and written while the next is rendered."""
    with ThreadPoolExecutor(1) as writer:
        before: Future[None] | None = None
        for index in indices:
            sample = maker.make(index)
            if before is not None:
                before.result()
                on_step()
            before = writer.submit(_write, file, sample)
        if before is not None:
            before.result()
            on_step()


def _write(file: IO[bytes], sample: Sample) -> None:
    write_sample(file, sample.key, sample.encode())
    file.flush()
