"""Every law holds on the code as it is, and each planted fault breaks the one that watches for it."""

import warnings
from functools import cache

import pytest

from simtest.estimators import bisector
from studies.gate.faults import FAULTS, HARMLESS, Mutation, planted
from tests.laws import all_laws
from tests.laws.law import Law, law

DETECTORS = {
    "sign flip of an axis": ("pose", "circle_pose", "normal_off"),
    "half-pixel shift of the isophotes": ("isophotes", "sub_pixel", "place_off"),
    "wrong K: focal length told 2 % too long": ("plane_errors", "plane", "cone_axis_off"),
    "degree for radian: tilt of a surface": ("truth", "truth", "normal_off"),
    "degree for radian: the metric": ("plane_errors", "light_offset", "error_over_law"),
    "isovalue off: traced at 0.9 t": ("isophotes", "isovalue", "radius_off"),
    "noise seed reused": ("noises", "noise", "distinct_rendered"),
    "falloff dropped": ("photometry", "photometry", "residual"),
    "normals in the world frame": ("rotated", "rotated_camera", "normal_off"),
    "light moved 1 mm": ("photometry", "photometry", "residual"),
    "ellipse fit unscaled": ("conditioning", "conditioning", "circle_off"),
}
"""What measures the law that sees a fault, and the law."""

IN_GEOMETRY = ("sign flip of an axis", "half-pixel shift of the isophotes", "isovalue off: traced at 0.9 t",
               "ellipse fit unscaled")  # fmt: skip


def broken(laws: list[Law]) -> set[tuple[str, str]]:
    return {(own.name, own.quantity) for own in laws if not own.holds}


shared = cache(all_laws.measures)


@pytest.mark.law
@pytest.mark.parametrize("name", [own.__name__ for own in all_laws.ALONE])
def test_a_law_holds(name):
    laws = shared()[name]()
    assert laws
    assert not [own for own in laws if not own.holds]


@pytest.mark.law
@pytest.mark.render
@pytest.mark.parametrize("name", [own.__name__ for own in all_laws.IN_SESSION + all_laws.RENDERING])
def test_a_law_of_rendered_frames_holds(name):
    test_a_law_holds(name)


def test_a_number_out_of_its_bounds_and_no_number_hold_nothing():
    assert [law("bird", "song", "", value, 1.0, 0.5).holds for value in (0.4, 0.5, 1.0, 1.1, float("nan"))] == [
        False, True, True, False, False
    ]  # fmt: skip


def sees(fault):
    measure, *law = DETECTORS[fault]
    with planted(*FAULTS[fault]), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return tuple(law) in broken(all_laws.measures()[measure]())


@pytest.mark.parametrize("fault", IN_GEOMETRY)
def test_a_fault_of_the_geometry_breaks_its_law(fault):
    assert sees(fault)


@pytest.mark.render
@pytest.mark.parametrize(
    "fault",
    [name if name == "falloff dropped" else pytest.param(name, marks=pytest.mark.slow)
     for name in FAULTS if name not in IN_GEOMETRY],
)  # fmt: skip
def test_a_planted_fault_breaks_its_law(fault):
    assert sees(fault)
    # And is gone afterwards.
    with pytest.raises(LookupError):
        Mutation(FAULTS[fault][0].function, FAULTS[fault][0].new + "nowhere", "").code()


@pytest.mark.render
@pytest.mark.parametrize("share", ["0.0", "2.0"])
def test_the_falloffs_shift_is_undone_once(share):
    with planted(Mutation(bisector._normals, "sightline - slope", f"sightline - {share} * slope")):
        assert ("bisector", "plane_off") in broken(all_laws.measures()["told_light"]())
    assert not broken(all_laws.measures()["told_light"]())


def test_the_noise_of_laws_is_the_same_each_time():
    own = [all_laws.measures()[name] for name in ("photon_noise", "stated_noise", "rigs", "glints")]
    assert [measure() for measure in own] == [measure() for measure in own]


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.parametrize("change", HARMLESS)
def test_a_harmless_change_breaks_none(change):
    with planted(*HARMLESS[change]):
        assert not broken([law for measure in all_laws.measures().values() for law in measure()])
