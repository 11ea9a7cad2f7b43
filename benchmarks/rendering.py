"""The renderer: labelled frames against Mitsuba's own integrators, updates, first frames and memory.

The scene is the generated colon, 200,000 triangles, seen at 640 x 480 with 16 samples a pixel or one. The references
are Mitsuba's `direct` and `aov` on the same scene (`mitsuba_frames`), with the labels that it knows: depth, position,
both normals, shape and triangle.
"""

import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.measuring import Figure
from benchmarks.mitsuba_frames import references
from benchmarks.timing import in_turns
from simtest.rendering import Session, backend
from simtest.spec import Scene, scene_from_dict

ROUNDS = 7
OFFSET_MM = 3.0
FRAMES = 1000


def _scene(
    samples: int = 16, light: dict[str, Any] | None = None, exponent: float = 50.0, fx: float = 400.0,
    path_share: float = 0.5,
) -> Scene:  # fmt: skip
    return scene_from_dict(
        {
            "surface": {"type": "anatomy", "path": "colon", "path_share": path_share},
            "reflectance": {"type": "phong", "exponent": exponent, "diffuse": 0.3},
            "rig": {"lights": [light or {}]},
            "camera": {"width": 640, "height": 480, "fx": fx, "fy": 400.0},
            "render": {"samples_per_pixel": samples},
        }
    )


def figures() -> list[Figure]:
    """Return the figures."""
    session = Session(_scene(), labelled=True)
    return [*_frames(session), *_tissue(), _updates(session), _compiled(session), _first_frame(), _memory(session)]


def _frames(session: Session) -> Iterator[Figure]:
    """Compare frames of new views with Mitsuba's in turns: labelled, like for like, and without labels.

    By processor time. Each round has a viewpoint of its own, whose search and placement count as ours.
    """
    limits = {(16, 0.0): (3.0, 3.0), (16, OFFSET_MM): (1.8, 2.2), (1, 0.0): (3.0, 1.8), (1, OFFSET_MM): (1.8, 1.4)}
    for (samples, offset), (nested_limit, alike_limit) in limits.items():
        times: dict[str, list[float]] = {}
        for number in range(1 + ROUNDS):
            scene = _scene(samples, {"offset_mm": offset}, path_share=0.3 + 0.03 * number)
            placing = _processor_s(lambda scene=scene: session.update(scene))
            functions = {**references(session, samples), "labelled": session.frame, "ours alone": session.radiance}
            for name, function in functions.items():
                taken = _processor_s(function) + (placing if name in ("labelled", "ours alone") else 0)
                # The first round compiles kernels.
                times.setdefault(name, []).extend([taken] if number else [])
        name = f"{samples} sample{'s' if samples > 1 else ''}, light {'aside' if offset else 'at the camera'}"
        about = ", ".join(f"{key} {1e3 * statistics.median(value):.0f} ms" for key, value in times.items())
        pairs = {
            "labelled frame over direct in aov": ("nested", "labelled", nested_limit),
            "labelled frame, like for like": ("alike", "labelled", alike_limit),
            "radiance alone over direct alone": ("radiance", "ours alone", 1.6 if samples > 1 else None),
        }
        for what, (slow, fast, at_least) in pairs.items():
            # Round by round: what the machine does meanwhile slows both alike.
            ratio = statistics.median(a / b for a, b in zip(times[slow], times[fast], strict=True))
            yield Figure(f"{what}: {name}", ratio, at_least, True, "x", about)


def _processor_s(function: Callable[[], object]) -> float:
    start = time.process_time()
    function()
    return time.process_time() - start


def _tissue() -> Iterator[Figure]:
    """Compare labelled frames of tissue and of the smooth surface in turns; and the search for glints with a frame."""
    disc = {"offset_mm": OFFSET_MM, "source": {"type": "disc", "radius_mm": 1.0}}
    relief = {"bands": [{"slope_deg": 5.0, "wavelength_mm": 1.5}]}
    tables = _scene(16, disc).model_dump(mode="json", exclude={"surface", "reflectance"}, exclude_defaults=True)
    tissue = scene_from_dict(
        {
            **tables,
            "surface": {"type": "anatomy", "path": "colon", "relief": relief},
            "reflectance": {"type": "tissue", "film": {"index": 1.36}, "albedo": {"preset": "colon_mucosa"}},
        }
    )
    # Every pixel sampled, as that of tissue is.
    plain = _scene(16, {"offset_mm": OFFSET_MM})
    plain = plain.model_copy(update={"render": plain.render.model_copy(update={"adaptive": False})})
    smooth = Session(plain, backend.COLOUR_VARIANT, labelled=True)
    rough = Session(tissue, labelled=True)
    radiance = rough.radiance()

    def search() -> None:
        rough._forget_misfits()
        rough.highlights(radiance)

    functions: dict[str, Callable[[], object]] = {
        "smooth": smooth.frame, "tissue": rough.frame, "radiance": rough.radiance, "glints": search,
    }  # fmt: skip
    times = in_turns(functions, ROUNDS)
    about = ", ".join(f"{key} {1e3 * value:.0f} ms" for key, value in times.items())
    name = "labelled tissue frame (relief, film, vessels, disc) over a smooth one of all samples, light aside"
    yield Figure(name, times["tissue"] / times["smooth"], 2.5, False, "x", about)
    yield Figure("search for glints over the frame's radiance", times["glints"] / times["radiance"], 0.8, False, "x",
                 about)  # fmt: skip


def _updates(session: Session) -> Figure:
    """Time an update of light, camera and reflectance together against a frame."""
    scenes = [_scene(16, {"offset_mm": 1 + 0.1 * i}, 40.0 + i, 390.0 + i) for i in range(20)]

    def update() -> None:
        for scene in scenes:
            session.update(scene)

    times = in_turns({"updates": update, "frame": session.frame}, ROUNDS)
    one = times["updates"] / len(scenes)
    about = f"update {1e3 * one:.2f} ms, frame {1e3 * times['frame']:.0f} ms"
    return Figure("update of light, camera and reflectance", 100 * one / times["frame"], 1.0, False, "%", about)


def _compiled(session: Session) -> Figure:
    """Count the kernels that a sweep compiles after its first frame."""
    import drjit as dr

    def sweep(i: int) -> None:
        profile = {"type": "cosine", "power": 1.0 + 0.3 * i}
        light = {"offset_mm": 1 + 0.1 * i, "power": 1.0 + i, "profile": profile, "direction": [0.01 * i, 0, 1]}
        session.update(_scene(4, light, 40.0 + i, 390.0 + i))
        session.frame()

    sweep(0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for i in range(1, 11):
            sweep(i)
        launched = dr.kernel_history((dr.KernelType.JIT,))
    missed = sum(not kernel["cache_hit"] for kernel in launched)
    return Figure("kernels compiled after a sweep's first frame", missed, 0, False, "", f"{len(launched)} launched")


def _first_frame() -> Figure:
    """Compare the first frame of a fresh process, whose kernels are on disk, with its later ones."""
    script = "from benchmarks.rendering import first_frame; first_frame()"
    ratios: list[tuple[float, float]] = []
    for _ in range(4):
        child = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1]
        )
        ratios.append(tuple(json.loads(child.stdout)))
    # The first child fills the cache.
    first, steady = (statistics.median(values) for values in zip(*ratios[1:], strict=True))
    about = f"first {1e3 * first:.0f} ms, later {1e3 * steady:.0f} ms"
    return Figure("first frame of a process, kernels on disk", first / steady, 2.0, False, "x", about)


def first_frame() -> None:
    """Print the time of the first labelled frame of this process, and the median of the next, s."""
    session = Session(_scene(), labelled=True)
    times = []
    for _ in range(6):
        start = time.perf_counter()
        session.frame()
        times.append(time.perf_counter() - start)
    print(json.dumps([times[0], statistics.median(times[1:])]))


def _memory(session: Session) -> Figure:
    """Compare the resident memory before and after many labelled frames of a moving light."""

    def render(count: int) -> None:
        for i in range(count):
            session.update(_scene(1, {"offset_mm": 1 + 1e-3 * i}, 50.0 + 0.01 * i))
            session.frame()

    render(50)
    before = resident_bytes()
    render(FRAMES)
    after = resident_bytes()
    about = f"{before / 2**20:.0f} MiB before, {after / 2**20:.0f} MiB after"
    return Figure(f"memory gained over {FRAMES} frames", 100 * (after / before - 1), 2.0, False, "%", about)


def resident_bytes() -> int:
    """Return the resident memory of this process; where the system does not tell, its peak."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
