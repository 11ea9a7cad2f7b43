"""What is shipped or preset, by name, with a line about each."""

import itertools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.runtime.resources import data_root

FOLDERS = {
    "scenes": "",
    "experiments": "experiments",
    "datasets": "datasets",
    "profiles": "profiles",
}
"""Kinds of shipped files, and their folders below scenes/."""


def shipped_files(kind: str) -> dict[str, str]:
    """Return the shipped files of one of `FOLDERS`: name, and title and first sentence, or that of its comment."""
    folder = data_root("scenes") / FOLDERS[kind]
    return {path.stem: _about(path) for path in sorted(folder.glob("*.toml"))}


def _about(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    data = tomllib.loads(text)
    if title := data.get("title"):
        return f"{title}: {_sentence(data['description'])}" if data.get("description") else str(title)
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    return _sentence(" ".join(line.removeprefix("#").strip() for line in lines))


def _sentence(text: str) -> str:
    return text.split(". ")[0].removesuffix(".")


def rig_presets() -> dict[str, str]:
    """Return the names of ``rig.preset``, with their lights."""
    from simtest.spec.lights import PRESETS

    return {name: _lights(ring.count, ring.radius_mm) for name, ring in PRESETS.items()}


def _lights(count: int, radius_mm: float) -> str:
    lights = "1 light" if count == 1 else f"{count} lights"
    return f"{lights} {radius_mm:g} mm beside the camera" if radius_mm else f"{lights} at the camera"


def sensor_presets() -> dict[str, str]:
    """Return the names of ``sensor.preset``, with what their frames went through."""
    from simtest.spec.sensor import PRESETS

    return {name: _chain(keys) for name, keys in PRESETS.items()}


def _chain(keys: Mapping[str, Any]) -> str:
    mosaic, coding = keys.get("mosaic"), keys.get("coding")
    parts = [
        f"mosaic {mosaic['pattern']}" if mosaic else "no mosaic",
        f"{keys['full_well']} electrons at full scale",
        f"{keys['read_noise']:g} of read noise",
        f"enlarged by 1/{keys['scaling']['factor']:g}" if "scaling" in keys else "",
        f"{coding['type'].upper()} of quality {coding['quality']}" if coding else "",
    ]
    return ", ".join(filter(None, parts))
