"""Launches and host reads of a frame: counted right, and no more than they were."""

import numpy as np
import pytest

from benchmarks.transfers import count, steps
from simtest.rendering import Session
from simtest.spec import load_scene

pytestmark = pytest.mark.render

SMALL = {"camera.width": 64, "camera.height": 48, "camera.fx": 48.0, "camera.fy": 48.0}

LIMITS = {
    "radiance": (2, 23),
    "labelled frame": (2, 23),
    "search for highlights": (5, 25),
    "update": (0, 0),
}
"""Compiled kernels and host reads at most: as many as there were when this was written, and fewer are welcome.

Vectors are read by component: as a whole, each number of lanes would compile kernels of its own.
"""


@pytest.fixture(scope="module")
def session():
    return Session(load_scene("cylinder", {**SMALL, "render.samples_per_pixel": 16}), labelled=True)


def test_launches_and_reads_are_counted(session):
    import drjit as dr  # after the backend has chosen its libLLVM

    mi = session.mi

    def work():
        x = dr.arange(mi.Float, 1000)
        for factor in (2.0, 3.0):
            np.array(dr.sin(x * factor))

    work()
    made = count(work)
    assert (made.kernels, made.reads, made.read_bytes) == (2, 2, 8000)
    assert made.sizes == [1000, 1000]
    nothing = count(lambda: None)
    assert (nothing.kernels, nothing.others, nothing.reads, nothing.read_bytes) == (0, 0, 0, 0)


def test_counting_ends_with_its_block(session):
    import drjit as dr

    before = dr.ArrayBase.__array__
    with pytest.raises(ZeroDivisionError):
        count(lambda: 1 / 0)
    assert dr.ArrayBase.__array__ is before


def test_a_frame_costs_no_more_launches_and_reads_than_it_did(session):
    works = steps(session)
    for name, (kernels, reads) in LIMITS.items():
        works[name]()
        made = count(works[name])
        assert made.kernels <= kernels, name
        assert made.reads <= reads, name
        assert made.compiled == 0, name
        # What is counted is repeatable.
        again = count(works[name])
        assert (again.kernels, again.reads, again.read_bytes) == (made.kernels, made.reads, made.read_bytes), name
