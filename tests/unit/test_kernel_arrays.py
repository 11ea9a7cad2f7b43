"""Arrays on their way into kernels and back: the same values, for any number and memory the same kernels, and few."""

import numpy as np
import pytest

from benchmarks.transfers import count, steps
from simtest.rendering import Session, backend
from simtest.rendering.kernel_values import to_kernel, vectors_from_kernel, vectors_to_kernel
from simtest.spec import load_scene

SMALL = {"camera.width": 64, "camera.height": 48, "camera.fx": 48.0, "camera.fy": 48.0}


@pytest.fixture(scope="module")
def mi():
    return backend.load()


def kernels(work):
    """Return the hashes of the kernels that some work runs."""
    import drjit as dr

    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        work()
        return {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}
    finally:
        dr.kernel_history_clear()
        dr.set_flag(dr.JitFlag.KernelHistory, before)


def test_values_come_back(mi):
    for size in (1, 5, 1000):
        rng = np.random.default_rng(size)
        points, numbers = rng.normal(size=(size, 3)), rng.integers(0, 2**32, size)
        there = vectors_to_kernel(mi.Vector3d, mi.Float64, points, np.float64)
        np.testing.assert_array_equal(vectors_from_kernel(there, np.float64), points)
        np.testing.assert_array_equal(np.array(to_kernel(mi.UInt32, numbers, np.uint32)), numbers)
        single = vectors_to_kernel(mi.Point3f, mi.Float, points, np.float32)
        np.testing.assert_array_equal(vectors_from_kernel(single, np.float64), points.astype(np.float32))


def test_memory_of_any_alignment_gives_one_kernel(mi):
    import drjit as dr

    room = np.arange(4096.0)
    seen, plain = set(), set()
    for start in range(8):
        some = room[start : start + 1000]
        seen |= kernels(lambda some=some: dr.eval(to_kernel(mi.Float64, some, np.float64) * 3 + 1))
        plain |= kernels(lambda some=some: dr.eval(mi.Float64(some) * 3 + 1))
    assert len(seen) == 1
    # Negative control: Dr.Jit's own conversion reads the memory in place.
    assert len(plain) > 1


def test_the_number_of_rays_is_in_no_kernel():
    session = Session(load_scene("sphere"))
    rng = np.random.default_rng(4)

    def cast(count):
        pixels = rng.uniform(100, 200, (count, 2))
        rays = session.sightlines.in_model(pixels)
        return lambda: (session.exact_hits(*rays), session.exact_points(pixels))

    first = kernels(cast(3))
    assert first
    for rays in (5, 8, 100):
        assert kernels(cast(rays)) == first


def test_launches_and_reads_are_counted(mi):
    import drjit as dr  # after the backend has chosen its libLLVM

    def work():
        x = dr.arange(mi.Float, 1000)
        for factor in (2.0, 3.0):
            np.array(dr.sin(x * factor))

    work()
    made, nothing, before = count(work), count(lambda: None), dr.ArrayBase.__array__
    assert (made.kernels, made.reads, made.read_bytes, made.sizes) == (2, 2, 8000, [1000, 1000])
    assert (nothing.kernels, nothing.others, nothing.reads, nothing.read_bytes) == (0, 0, 0, 0)
    # Counting ends with its block.
    with pytest.raises(ZeroDivisionError):
        count(lambda: 1 / 0)
    assert dr.ArrayBase.__array__ is before


LIMITS = {"radiance": (2, 23), "labelled frame": (2, 23), "search for highlights": (5, 25), "update": (0, 0)}
"""Compiled kernels and host reads at most: as many as there were when this was written, and fewer are welcome.

Vectors are read by component: as a whole, each number of lanes would compile kernels of its own.
"""


def test_a_frame_costs_no_more_launches_and_reads_than_it_did():
    works = steps(Session(load_scene("cylinder", {**SMALL, "render.samples_per_pixel": 16}), labelled=True))
    for name, (kernels, reads) in LIMITS.items():
        works[name]()
        made = count(works[name])
        assert made.kernels <= kernels, name
        assert made.reads <= reads, name
        assert made.compiled == 0, name
        # What is counted is repeatable.
        again = count(works[name])
        assert (again.kernels, again.reads, again.read_bytes) == (made.kernels, made.reads, made.read_bytes), name
