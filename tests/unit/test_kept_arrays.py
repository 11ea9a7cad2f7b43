"""Arrays kept on disk: the same with and without, made anew when damaged, bounded, safe with several processes."""

import os
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

from simtest.runtime import arrays
from simtest.runtime.arrays import cache_folder, kept, only_reading
from simtest.runtime.resources import find
from simtest.spec.reflectance import TissueColour
from simtest.spec.surfaces import PlaneSurface, Relief, ReliefBand
from simtest.surfaces import colon, liver, relief_field, tissue_pattern
from simtest.surfaces.analytic import Plane
from simtest.surfaces.recipe import load_recipe

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True, False])}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def counted(arrays=ARRAYS):
    calls = []

    def make():
        calls.append(1)
        return arrays

    return make, calls


def assert_same(found, expected=ARRAYS):
    assert set(found) == set(expected)
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)


def test_arrays_are_made_once_for_a_key(folder):
    make, calls = counted()
    for key in ("one", "one", "two", "one"):
        assert_same(kept("kind", key, make))
    assert len(calls) == 2
    assert len(list(folder.iterdir())) == 2


def test_other_code_makes_other_files(folder, monkeypatch):
    make, calls = counted()
    kept("kind", "one", make)
    monkeypatch.setattr(arrays, "_code", lambda: "changed")
    kept("kind", "one", make)
    assert len(calls) == 2


def test_the_hash_of_the_code_follows_sources_versions_and_processor(monkeypatch, tmp_path):
    (tmp_path / "surfaces").mkdir()
    file = tmp_path / "surfaces" / "one.py"
    file.write_text("a = 1")
    monkeypatch.setattr(arrays, "_ROOT", tmp_path)
    monkeypatch.setattr(arrays, "SOURCES", ("surfaces",))
    hashes = [arrays._code.__wrapped__() for _ in range(2)]
    file.write_text("a = 2")
    hashes.append(arrays._code.__wrapped__())
    monkeypatch.setattr(arrays.provenance, "processor", lambda: "another")
    hashes.append(arrays._code.__wrapped__())
    monkeypatch.setattr(arrays.importlib.metadata, "version", lambda name: "0")
    hashes.append(arrays._code.__wrapped__())
    assert hashes[0] == hashes[1]
    assert len(set(hashes)) == 4


@pytest.mark.parametrize("damage", ["truncated", "empty", "changed", "text"])
def test_a_damaged_file_is_made_anew(folder, damage):
    make, calls = counted()
    kept("kind", "one", make)
    (path,) = folder.iterdir()
    content = path.read_bytes()
    at = content.index(ARRAYS["a"].tobytes()[8:16])
    bad = {
        "truncated": content[:-60],
        "empty": b"",
        "changed": content[:at] + b"\x01" + content[at + 1 :],
        "text": b"no archive",
    }
    path.write_bytes(bad[damage])
    assert_same(kept("kind", "one", make))
    assert len(calls) == 2
    assert path.read_bytes() == content
    kept("kind", "one", make)
    assert len(calls) == 2


def test_the_folder_is_bounded_and_the_files_used_last_stay(folder, monkeypatch):
    big = {"a": np.zeros(1000)}
    monkeypatch.setattr(arrays, "MAX_BYTES", 3 * 8500)
    make, calls = counted(big)
    for number in range(3):
        kept("kind", str(number), make)
        for age, path in enumerate(sorted(folder.iterdir(), key=lambda p: p.stat().st_mtime)):
            os.utime(path, (time.time() - 1000 + age, time.time() - 1000 + age))
    kept("kind", "0", make)  # used again: no longer the oldest
    kept("kind", "3", make)
    assert len(list(folder.iterdir())) == 3
    assert len(calls) == 4
    kept("kind", "0", make)
    assert len(calls) == 4
    kept("kind", "1", make)
    assert len(calls) == 5


def test_what_an_ended_process_left_is_removed(folder):
    folder.mkdir()
    old, new = folder / ".kind-1.77.part.npz", folder / ".kind-2.78.part.npz"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (time.time() - 7200, time.time() - 7200))
    kept("kind", "one", counted()[0])
    assert (old.exists(), new.exists()) == (False, True)


def test_the_variable_names_the_folder_or_switches_it_off_and_a_bad_one_costs_only_time(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    for value in ("off", "OFF", str(tmp_path / "file")):
        monkeypatch.setenv("SIMTEST_CACHE", value)
        make, calls = counted()
        for _ in range(2):
            assert_same(kept("kind", "one", make))
        assert (cache_folder() is None) == (value.lower() == "off")
        assert len(calls) == 2
    monkeypatch.delenv("SIMTEST_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "simtest" / "arrays"


def test_what_warns_is_not_kept_and_warns_each_time(folder):
    def make():
        warnings.warn("too dense", stacklevel=1)
        return ARRAYS

    for _ in range(2):
        with pytest.warns(UserWarning, match="too dense"):
            assert_same(kept("kind", "one", make))
    assert not folder.exists()


def test_only_reading_keeps_nothing_more_of_all_or_of_some_kinds(folder):
    make, calls = counted()
    kept("relief", "one", make)
    with only_reading():
        assert_same(kept("relief", "one", make))
        assert len(calls) == 1
        assert_same(kept("relief", "two", make))
    with only_reading("relief"):
        for kind in ("relief", "colon"):
            assert_same(kept(kind, "two", make))
    assert sorted(path.name.split("-")[0] for path in folder.iterdir()) == ["colon", "relief"]
    assert len(calls) == 4
    kept("relief", "two", make)
    assert len(list(folder.iterdir())) == 3


def test_several_processes_at_once(folder):
    code = (
        "import numpy as np; from simtest.runtime.arrays import kept\n"
        "for i in range(20):\n"
        "    a = kept('kind', str(i % 4), lambda: {'a': np.full(20000, i % 4)})['a']\n"
        "    assert len(a) == 20000 and (a == i % 4).all()\n"
    )
    children = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(3)]
    assert [child.wait() for child in children] == [0, 0, 0]
    assert len(list(folder.iterdir())) == 4


def anatomy(name, module):
    def make():
        built = module.build(load_recipe(find(name, "meshes")), 4.0)
        return vars(built.mesh) | ({"corners": built.corners} if name == "colon" else {}) | {"key": built.key}

    return module.build, make


def relief():
    bands = (ReliefBand(wavelength_mm=1.0, slope_deg=4.0), ReliefBand(wavelength_mm=0.4, slope_deg=2.0, kind="pits"))
    field = relief_field.make_relief(Relief(bands=bands, seed=3))
    parts = [(i, name) for i in range(2) for name in ("lattice_from_model", "coefficients", "diffused")]
    told = {"deviation": field.deviation, "finest": field.finest_wave}
    return told | {f"{name} {i}": getattr(field.bands[i], name) for i, name in parts}


def pattern():
    return tissue_pattern._packed(tissue_pattern.make_pattern(Plane(PlaneSurface()), TissueColour()))


MADE = {
    "liver": anatomy("liver", liver),
    "colon": anatomy("colon", colon),
    "relief": (relief_field._make_field, relief),
    "pattern": (tissue_pattern._make, pattern),
}


@pytest.mark.parametrize("name", MADE)
def test_what_the_package_keeps_is_the_same_from_disk(folder, name):
    cached, make = MADE[name]
    made = []
    for _ in range(2):
        cached.cache_clear()
        made.append(make())
    cached.cache_clear()
    assert len(list(folder.iterdir())) == 1
    first, second = made
    assert set(first) == set(second)
    for key, values in first.items():
        if isinstance(values, np.ndarray):
            assert second[key] is not values
            assert (second[key].dtype, second[key].tobytes()) == (values.dtype, values.tobytes())
        else:
            assert second[key] == values
