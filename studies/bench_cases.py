"""Freezes a version of the benchmark: spells out every default of its scenes, and pins their hashes.

``python -m studies.bench_cases v2`` freezes scenes/bench/v2: a copy of another version without its hashes.json, whose
suite.toml and scenes were changed by hand. A folder that holds hashes is refused: a released version never changes.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.bench.suite import HASHES, FrozenCase, read_suite
from simtest.errors import InputError
from simtest.runtime.files import write_json
from simtest.runtime.resources import data_root
from simtest.spec import AnatomySurface, Scene, scene_from_dict
from simtest.spec.toml_files import toml_tables, toml_value
from simtest.surfaces.recipe import load_recipe


def resolved_tables(scene: Scene) -> dict[str, Any]:
    """Return a scene's tables with every default written out, and every preset and recipe replaced by its numbers.

    Keys without a value are left out: TOML has none.
    """
    tables: dict[str, Any] = scene.model_dump(mode="json", exclude_none=True)
    if scene.rig.preset is not None:
        lights = [light.model_dump(mode="json", exclude_none=True) for light in scene.rig.lights]
        lights = [
            {key: value for key, value in light.items() if key not in ("offset_mm", "azimuth_deg")} for light in lights
        ]
        tables["rig"] = {"lights": lights, "seed": scene.rig.seed, "emission_known": scene.rig.emission_known}
    tables["sensor"].pop("preset", None)
    tables["reflectance"].get("albedo", {}).pop("preset", None)
    if isinstance(scene.surface, AnatomySurface) and (file := scene.surface.file()).suffix == ".toml":
        recipe = load_recipe(file, scene.surface.recipe_values)
        # The type says which file it is read with, and the seed is the surface's own.
        tables["surface"]["recipe"] = recipe.model_dump(mode="json", exclude_none=True, exclude={"type", "seed"})
        tables["surface"]["seed"] = recipe.seed
    return tables


def unfrozen_keys(case: FrozenCase) -> list[str]:
    """Return the key paths whose values the frozen file does not state: defaults that were added after the freeze.

    Raises `InputError` if the file's scene resolves to another one than it states.
    """
    now = _flat(resolved_tables(scene_from_dict(case.scene, str(case.file))))
    frozen = _flat(case.scene)
    for path, value in frozen.items():
        if now.get(path) != value:
            raise InputError(f"{case.file}: {path} = {value!r} is read as {now.get(path)!r}")
    return sorted(now.keys() - frozen.keys())


def _flat(value: Any, above: str = "") -> dict[str, Any]:
    """Return the leaves of nested tables and lists by key path; empty tables and lists are leaves."""
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    flat: dict[str, Any] = {}
    for key, item in items:
        flat |= _flat(item, f"{above}.{key}" if above else str(key))
    return flat or ({above: value} if above else {})


def freeze(folder: Path) -> None:
    """Freeze a version's folder; raise `InputError` where it is frozen already."""
    if (folder / HASHES).exists():
        raise InputError(f"{folder}: is frozen; a changed case must be a new version")
    for case in read_suite(folder).cases:
        tables = resolved_tables(scene_from_dict(case.scene, str(case.file)))
        name = tables.pop("name")
        case.file.write_text(f"name = {toml_value(name)}\n\n{toml_tables(tables)}", encoding="utf-8")
    suite = read_suite(folder)
    write_json(folder / HASHES, {"suite": suite.digest, "cases": suite.hashes})


if __name__ == "__main__":
    try:
        freeze(data_root("scenes") / "bench" / sys.argv[1])
    except InputError as error:
        sys.exit(f"bench_cases: {error}")
