"""Verifies a dataset's folder: every byte against its hash, every value against its range and the other values.

It also makes one sample again alone, and compares it with the stored one.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from simtest.dataset.card import CARD, make_card
from simtest.dataset.fields import BY_SUFFIX, COVERING, FIELDS, INSTRUMENT, POLYP, VISIBLE
from simtest.dataset.index import FOLDERS, SAMPLES, make_tables, shard_files, shortfall
from simtest.dataset.maker import Maker
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
from simtest.dataset.metadata import SampleMeta, has_relief
from simtest.dataset.plan import Plan, Shard
from simtest.dataset.reader import open_manifest
from simtest.dataset.shard import PART, BrokenShardError, Sample, decode, read_member, sample_key, samples
from simtest.dataset.shard_writer import remake
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.runtime import provenance
from simtest.runtime.arrays import AnyArray
from simtest.runtime.locks import LOCK, exclusive_folder
from simtest.runtime.processes import Engine
from simtest.spec.camera import SceneCamera
from simtest.spec.surfaces import Relief
from simtest.validation.run_folder import EXPORT, EXPORTING
from simtest.validation.runner import Progress

MAX_DEPTH_NORMAL_DEG = 5.0
"""The median angle between a sample's normals and those of its depth map is far below this, whatever its noise."""

MAX_DEPTH_ERROR = 0.05
"""The nearest pixel's depth differs from a highlight's distance by less than this share, unless units differ."""

MAX_SLOPES = 4.0
"""The median angle between fine normals and those of the base is 1.2 slopes of the relief, and far below this many."""


@dataclass(frozen=True)
class Fault:
    """What is wrong with a file, named as in the folder."""

    file: str
    what: str

    def __str__(self) -> str:
        return f"{self.file}: {self.what}"


def verify(folder: Path, progress: Progress | None = None) -> list[Fault]:
    """Check a dataset; return its faults, none if it is sound.

    `progress` is called with samples checked, samples in all, and the shard. Raises `InputError` if there is no such
    folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    try:
        manifest = read_manifest(folder)
        plan = manifest.plan()
    except (ManifestError, ValueError, KeyError, TypeError) as error:
        said = str(error) if isinstance(error, ManifestError) else f"{NAME}: its dataset is malformed ({error})"
        return [Fault(NAME, said.removeprefix(f"{NAME}: "))]
    faults = list(_files(folder, manifest, plan))
    damaged = {fault.file for fault in faults}
    # content of shards
    done = 0
    for shard in plan.shards:
        if shard.name not in damaged and shard.name in manifest.shards:
            found = list(_shard(folder, shard))
            damaged |= {fault.file for fault in found}
            faults += found
        done += len(shard.indices)
        if progress:
            progress(done, plan.dataset.samples, f"samples, {shard.name}")
    # Tables are compared with sound shards only.
    if not any(shard.name in damaged for shard in plan.shards) and len(manifest.shards) == len(plan.shards):
        faults += _tables(folder, manifest, plan, damaged)
    return faults


def _files(folder: Path, manifest: Manifest, plan: Plan) -> Iterator[Fault]:
    """Check which files exist, and their sizes and hashes."""
    planned = {shard.name for shard in plan.shards}
    belonging = _belonging(plan)
    # manifest against plan
    for name in sorted(planned - set(manifest.shards)):
        yield Fault(name, "not finished; the dataset's command goes on with it")
    for name in sorted(set(manifest.shards) - planned):
        yield Fault(NAME, f"lists {name}, which the dataset does not have")
    if not planned - set(manifest.shards):
        # Another version of simtest may write other tables.
        lacking = (belonging if _is_of_this_code(manifest) else {SAMPLES, CARD}) - {*manifest.shards, *manifest.tables}
        yield from (Fault(name, "missing in the manifest") for name in sorted(lacking))
        if not (lacking or manifest.complete):
            yield Fault(CARD, "not finished; the dataset's command goes on with it")
    # files against manifest
    for name, entry in {**manifest.shards, **manifest.tables}.items():
        yield from _against(folder, name, entry)
    # files that do not belong
    known = {NAME, LOCK, EXPORT, EXPORTING, *manifest.shards, *manifest.tables, *belonging}
    known |= {name for name in FOLDERS if (folder / name).is_dir() and not (folder / name).is_symlink()}
    for path in sorted(path for name in ("*", *(f"{name}/*" for name in FOLDERS)) for path in folder.glob(name)):
        name = path.relative_to(folder).as_posix()
        if name in known:
            continue
        if PART in path.name:
            if not planned - set(manifest.shards):
                yield Fault(name, "left over from a stopped run")
        else:
            yield Fault(name, "does not belong to the dataset")


def _belonging(plan: Plan) -> set[str]:
    """Return the files of a finished dataset besides its manifest."""
    return {SAMPLES, CARD, *(name for shard in plan.shards for name in shard_files(shard))}


def _is_of_this_code(manifest: Manifest) -> bool:
    return manifest.origin.get("source") == provenance.source_hash()


def _against(folder: Path, name: str, entry: FileEntry) -> Iterator[Fault]:
    path = folder / name
    if path.is_symlink() or not path.is_file():
        yield Fault(name, "is no plain file" if path.exists() else "missing")
    elif said := entry.wrong_size(path):
        yield Fault(name, said)
    elif file_entry(path).sha256 != entry.sha256:
        yield Fault(name, "differs from its SHA-256 in the manifest")


def repair_files(folder: Path, faults: list[Fault], engine: Engine, progress: Progress | None = None) -> list[Fault]:
    """Make broken files anew, remove files that do not belong, and verify once more; return what is still broken.

    `faults` are those of `verify`; `engine` runs the tasks; `progress` is called with samples done, samples in all, and
    what is being done.
    """
    if any(fault.file == NAME for fault in faults):
        raise InputError(f"{folder / NAME}: is broken; remove it with the other files, and give the dataset's command")
    manifest = read_manifest(folder)
    now = new_manifest(manifest.plan(), str(manifest.origin["variant"]))
    check_same(folder, manifest, now)
    known = _belonging(now.plan())
    # A folder may hold anything: it stays, and is listed again.
    foreign = [folder / fault.file for fault in faults if fault.file not in known]
    for path in (path for path in foreign if path.is_symlink() or not path.is_dir()):
        path.unlink(missing_ok=True)
    remake(folder, manifest, [fault.file for fault in faults if fault.file in known], engine, progress)
    return verify(folder, progress)


# Content ------------------------------------------------------------------------------------------------------------


def _shard(folder: Path, shard: Shard) -> Iterator[Fault]:
    indices: list[int] = []
    try:
        with (folder / shard.name).open("rb") as file:
            for sample in samples(file):
                indices.append(int(sample.meta.get("index", -1)))
                if sample.key != sample_key(indices[-1]) or sample.meta.get("split") != shard.split:
                    yield Fault(shard.name, f"sample {sample.key}: index or split do not fit its place")
                members = {s: read_member(file, sample, s) for s in sample.members if s in BY_SUFFIX}
                yield from (Fault(shard.name, f"sample {sample.key}: {w}") for w in check_sample(members, sample.meta))
    except BrokenShardError as error:
        yield Fault(shard.name, str(error))
        return
    if tuple(indices) != shard.indices:
        yield Fault(shard.name, f"holds {len(indices)} samples; must hold {len(shard.indices)}, in their order")


def check_sample(members: dict[str, bytes], meta: SampleMeta) -> Iterator[str]:
    """Yield what is wrong with a sample's values, of which the metadata's may be missing or malformed.

    Sizes, ranges, unit normals that face the camera, depth against normals, and counts are checked; `members` are bytes
    by suffix.
    """
    # decoding
    try:
        sample = decode(members, meta)
        camera = SceneCamera.model_validate(meta["scene"]["camera"]).model()
        highlights = meta["highlights"]
        relief = _relief(meta)
        instruments = meta["scene"].get("instruments") or []
        listed = len(instruments) if isinstance(instruments, list) else 0
    except (ValueError, KeyError, TypeError) as error:
        yield f"cannot be decoded ({error})"
        return
    if lacking := [own.name for own in FIELDS if own.is_required(meta) and own.name not in sample.images]:
        yield f"has no {', '.join(lacking)}"
        return
    # sizes
    size = (camera.height, camera.width)
    for name, array in sample.images.items():
        if array.shape[:2] != size:
            yield f"{name} is {array.shape[:2]}; must be {size}"
            return
    # depth, normals and curvatures
    yield from _surface(sample, camera, relief)
    for name, most in ((INSTRUMENT, listed), (POLYP, len(meta.get("polyps", ()))), (COVERING, 3)):
        if name in sample.images and (highest := int(sample.images[name].max())) > most:
            yield f"{name} has the value {highest}; must be at most {most}"
    yield from _visible(sample)
    # highlights
    depth, instance = sample.images["depth"], sample.images["instance"]
    if instance.max() > len(highlights):
        yield f"instance names highlight {int(instance.max())} of {len(highlights)}"
    areas = np.bincount(instance.ravel(), minlength=len(highlights) + 1)[1:].tolist()
    for number, highlight in enumerate(highlights):
        region = highlight.get("region")
        if region is not None and (region["instance_px"] or 0) != areas[number]:
            yield f"highlight {number}: has {areas[number]} pixels; instance_px is {region['instance_px']}"
        normal, position = np.asarray(highlight["normal"]), np.asarray(highlight["position_mm"])
        if abs(float(np.linalg.norm(normal)) - 1) > 1e-6 or normal @ position >= 0:
            yield f"highlight {number}: its normal is no unit vector that faces the camera"
        column, row = (min(int(v), end - 1) for v, end in zip(highlight["bp_px"], size[::-1], strict=True))
        seen = float(depth[row, column])
        if highlight["isolated"] and not abs(seen / highlight["distance_mm"] - 1) < MAX_DEPTH_ERROR:
            yield f"highlight {number}: depth is {seen:g} mm and its distance {highlight['distance_mm']:g} mm"


def _visible(sample: Sample) -> Iterator[str]:
    """Check the pixels of the visible highlights, where they are kept, against the list."""
    if VISIBLE not in sample.images:
        return
    spots = sample.meta.get("visible_highlights", [])
    areas = np.bincount(sample.images[VISIBLE].ravel(), minlength=len(spots) + 1)[1:]
    if len(areas) > len(spots):
        yield f"{VISIBLE} names highlight {len(areas)} of {len(spots)}"
        return
    for number, (spot, area) in enumerate(zip(spots, areas.tolist(), strict=True)):
        if spot.get("area_px") != area:
            yield f"visible highlight {number}: has {area} pixels; area_px is {spot.get('area_px')}"


def _relief(meta: SampleMeta) -> Relief | None:
    """Return the relief of a sample's surface; None where it is smooth."""
    surface = meta["scene"]["surface"]
    return Relief.model_validate(surface["relief"]) if has_relief(meta) and isinstance(surface, dict) else None


def _surface(sample: Sample, camera: Camera, relief: Relief | None) -> Iterator[str]:
    # Depth is that of the base.
    base = "" if relief is None else "_base"
    depth, normal, curvature = (sample.images[name] for name in ("depth", f"normal{base}", f"curvature{base}"))
    there = np.isfinite(depth)
    if not there.any():
        yield "shows no surface"
        return
    if float(np.nanmin(depth)) <= 0:
        yield "depth is not positive"
        return
    if (there != np.isfinite(normal[..., 0])).any():
        yield "normals and depth are not there at the same pixels"
        return
    rays = camera.unproject(camera.pixel_centres().reshape(-1, 2)).reshape(*depth.shape, 3)
    facing = np.sum(rays * normal, axis=-1)
    # An octahedral normal is rounded by 1e-4.
    if np.nanmax(facing) > 1e-3:
        yield f"{np.count_nonzero(facing > 1e-3)} normals do not face the camera"
    if (curvature[..., 0] > curvature[..., 1]).any():
        yield "k_min is above k_max"
    angle = _angle_to_depth(depth[..., None] * rays, normal)
    if angle > MAX_DEPTH_NORMAL_DEG:
        yield f"normals are {angle:.1f} deg from those of the depth map (median); at most {MAX_DEPTH_NORMAL_DEG:g}"
    if relief is not None:
        yield from _fine(sample, relief)


def _fine(sample: Sample, relief: Relief) -> Iterator[str]:
    """Check the fine surface against the base."""
    base, normal, curvature = (sample.images[name] for name in ("normal_base", "normal", "curvature"))
    if (np.isfinite(base[..., 0]) != np.isfinite(normal[..., 0])).any():
        yield "normals of the fine surface and of the base are not there at the same pixels"
        return
    if (curvature[..., 0] > curvature[..., 1]).any():
        yield "k_min of the fine surface is above k_max"
    angle, most = float(np.nanmedian(angle_deg(base, normal))), MAX_SLOPES * relief.slope_deg
    if angle > most:
        yield f"fine normals are {angle:.1f} deg from those of the base (median); at most {most:.1f} on this relief"


def _angle_to_depth(points: AnyArray, normal: AnyArray) -> float:
    """Return the median angle, deg, between normals and those of the differences between neighbouring points."""
    # Central differences along rows and columns span the surface.
    along_x = points[1:-1, 2:] - points[1:-1, :-2]
    along_y = points[2:, 1:-1] - points[:-2, 1:-1]
    own = np.cross(along_y, along_x)
    with np.errstate(invalid="ignore", divide="ignore"):
        own /= np.linalg.norm(own, axis=-1, keepdims=True)
    inner = normal[1:-1, 1:-1]
    # Of either sign: whether normals face the camera is checked separately.
    sine = np.linalg.norm(np.cross(own, inner), axis=-1)
    return float(np.degrees(np.nanmedian(np.arcsin(np.clip(sine, 0, 1)))))


def _tables(folder: Path, manifest: Manifest, plan: Plan, damaged: set[str]) -> list[Fault]:
    # Another version of simtest may write other columns and another card; their hashes are checked in any case.
    same_code, faults = _is_of_this_code(manifest), list[Fault]()
    for name, table in make_tables(plan, folder):
        if name in damaged or name not in manifest.tables:
            continue
        try:
            there = pl.read_parquet(folder / name)
        except (pl.exceptions.PolarsError, OSError) as error:
            faults.append(Fault(name, f"cannot be read ({str(error).splitlines()[0]})"))
            continue
        # Columns in common, if other code has written the tables
        columns = table.columns if same_code else [name for name in there.columns if name in table.columns]
        if (same_code and there.columns != columns) or not there.select(columns).equals(table.select(columns)):
            faults.append(Fault(name, "differs from what the shards say"))
    # Made from the tables, the card is compared with sound ones only.
    if same_code and not damaged and not faults:
        card = make_card(plan, manifest, shortfall(plan, folder))
        if (folder / CARD).read_text(encoding="utf-8") != card:
            faults.append(Fault(CARD, "differs from the card that the manifest gives"))
    return faults


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
