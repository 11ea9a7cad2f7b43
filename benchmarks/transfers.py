"""What a frame costs a GPU before it computes anything: launches of kernels, and results that the host waits for.

The counts are those of the LLVM variants; the CUDA variants run the same Python and so launch and read as often. They
are the same in every run, whatever the machine. A read is one Dr.Jit array that becomes a NumPy array: on a GPU each
waits for the kernels before it, and copies. Not counted: what the host uploads (numbers of a scene, rays of single
casts), which needs no waiting.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.measuring import Figure
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session
from simtest.spec import Scene, load_dataset, load_scene, scene_from_dict

SIZE = {"width": 640, "height": 480, "fx": 400.0, "fy": 400.0}
KIB = 1024


@dataclass
class Transfers:
    """What was launched and read.

    `kernels`: compiled kernels that were launched; `others`: launches of the library's own small kernels: sums,
    fills, tables of calls; `reads`: dr.Jit arrays that became NumPy arrays; `read_bytes`: their size together;
    `compiled`: kernels that had to be compiled or read from disk first.
    """

    kernels: int = 0
    others: int = 0
    reads: int = 0
    read_bytes: int = 0
    compiled: int = 0
    sizes: list[int] = field(default_factory=list)


@contextmanager
def counted() -> Iterator[Transfers]:
    """Count what happens inside; Dr.Jit must have been loaded by a session before."""
    import drjit as dr

    made = Transfers()
    kind: Any = dr.ArrayBase
    convert = kind.__array__

    def read(array: Any, *arguments: Any, **options: Any) -> Any:
        values = convert(array, *arguments, **options)
        made.reads += 1
        made.read_bytes += values.nbytes
        return values

    kind.__array__ = read
    try:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            yield made
            launched = dr.kernel_history()
    finally:
        kind.__array__ = convert
    own = [kernel for kernel in launched if kernel["type"] == dr.KernelType.JIT]
    made.kernels, made.others = len(own), len(launched) - len(own)
    made.compiled = sum(not kernel["cache_hit"] for kernel in own)
    made.sizes = [kernel["size"] for kernel in own]


def count(function: Callable[[], object]) -> Transfers:
    """Count what a call launches and reads."""
    with counted() as made:
        function()
    return made


def smooth_scene(samples: int = 16, camera: Mapping[str, float] | None = None, **surface: Any) -> Scene:
    """Return a smooth colon, or another surface, under a light beside the camera."""
    return scene_from_dict(
        {
            "surface": {"type": "anatomy", "path": "colon", **surface},
            "reflectance": {"type": "phong", "exponent": 100.0, "diffuse": 0.3},
            "rig": {"lights": [{"offset_mm": 3.0}]},
            "camera": {**SIZE, **(camera or {})},
            "render": {"samples_per_pixel": samples},
        }
    )


def steps(session: Session) -> dict[str, Callable[[], object]]:
    """Return what is done with one view of a scene, in the order in which it is done."""
    radiance = session.frame().radiance
    middle = np.array([[session.camera.width / 2, session.camera.height / 2]])

    def search() -> object:
        session._forget_misfits()
        return session.highlights(radiance)

    return {
        "update": lambda: session.update(session.scene),
        "radiance": session.radiance,
        "labelled frame": session.frame,
        "search for highlights": search,
        "cast of one ray": lambda: session.exact_points(middle),
    }


def figures() -> list[Figure]:
    """Count for smooth frames, for tissue, and for whole samples of a dataset."""
    shown: list[Figure] = []
    scenes = {"colon": smooth_scene(), "liver": smooth_scene(path="liver"), "tissue, colon": load_scene("tissue_colon")}
    for name, scene in scenes.items():
        session = Session(scene, labelled=True)
        for what, function in steps(session).items():
            function()  # the first one compiles
            shown += _figures(f"{name}: {what}", count(function))
    maker = Maker(Plan(load_dataset("smooth", {"samples": 1000})))
    maker.make(0)
    shown += _figures("sample of the dataset smooth", count(lambda: maker.make(1)))
    return shown


def _figures(name: str, made: Transfers) -> list[Figure]:
    about = f"{made.kernels} compiled kernels, {made.others} small ones; largest of {max(made.sizes, default=0)} lanes"
    return [
        Figure(f"{name}: launches", made.kernels + made.others, unit="", about=about),
        Figure(f"{name}: host reads", made.reads, unit="", about=f"{made.read_bytes / KIB:.0f} KiB"),
    ]
