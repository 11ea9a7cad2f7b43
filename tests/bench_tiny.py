"""A tiny suite of the benchmark, quick to run, and certificates of it with a change."""

import copy
from pathlib import Path
from typing import Any

from simtest.bench.run import BenchRun, write_certificate
from simtest.bench.suite import HASHES, SUITE, Suite, load_suite, read_suite
from simtest.runtime.files import write_json
from simtest.spec import load_scene
from simtest.spec.toml_files import toml_tables
from studies.bench_cases import resolved_tables

SUITE_TEXT = """
name = "tiny"
title = "Tiny"
description = "Two small planes."
format = 1
seed = 5
[[parts]]
name = "smooth"
title = "Smooth"
description = "Planes."
[[parts]]
name = "dense"
title = "Dense"
description = "Maps."
kind = "maps"
[[cases]]
part = "smooth"
name = "plane"
draws = 3
realisations = 2
[cases.draw]
"surface.tilt_deg" = { kind = "uniform", low = 1.0, high = 8.0 }
[[cases]]
part = "dense"
name = "plane"
draws = 2
[cases.draw]
"surface.tilt_deg" = { kind = "uniform", low = 1.0, high = 8.0 }
"""


def tiny_suite(folder: Path) -> Suite:
    """Write the suite into a new folder, with its pinned hashes, and read it."""
    small = {"camera.width": 96, "camera.height": 96, "camera.fx": 96.0, "camera.fy": 96.0}
    tables = resolved_tables(load_scene("plane", small | {"sensor.noise_sigma": 0.02}))
    tables.pop("name")
    for part in ("smooth", "dense"):
        (folder / part).mkdir(parents=True)
        (folder / part / "plane.toml").write_text(toml_tables(tables))
    (folder / SUITE).write_text(SUITE_TEXT)
    read = read_suite(folder)
    write_json(folder / HASHES, {"suite": read.digest, "cases": read.hashes})
    return load_suite("v1", folder)


def copied(made: BenchRun, folder: Path, change: Any = None) -> Path:
    """Write a certificate with a change and a hash that fits it."""
    content = copy.deepcopy(made.content)
    if change:
        change(content)
    folder.mkdir(parents=True, exist_ok=True)
    return write_certificate(folder, content)
