"""The choice of the rendering backend: bad libLLVMs are told apart, and neither they nor the cache do harm."""

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from simtest.errors import BackendError, InputError
from simtest.rendering import backend
from simtest.rendering.backend import Candidate, candidates, choose_library, colour_variant, probe, requested_variant

SYSTEM = Path("/usr/lib/x86_64-linux-gnu")
MAIN = "from simtest.cli.main import main; main()"


def file_of(text):
    """Return what makes a file of a text in a folder."""

    def give(folder):
        (folder / "library.so").write_text(text)
        return folder / "library.so"

    return give


def installed(name):
    def give(_):
        if not (SYSTEM / name).is_file():
            pytest.skip(f"{name} is not installed")
        return SYSTEM / name

    return give


BAD = {
    "folder": (lambda folder: folder, "is a folder; must be the file libLLVM.so itself"),
    "missing": (lambda folder: folder / "none.so", "no such file"),
    "empty": (file_of(""), "is not a usable libLLVM ("),
    "text": (file_of("not a library\n"), "is not a usable libLLVM ("),
    "another library": (installed("libm.so.6"), "lacks core API"),
    "LLVM 14": (installed("libLLVM-14.so.1"), "(14) is too old"),
    "LLVM 15": (installed("libLLVM-15.so.1"), "aborts the process when a kernel is compiled"),
}


@pytest.fixture(autouse=True)
def clean(monkeypatch, tmp_path):
    """Keep the user's cache, variables and loaded renderer out of these tests."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(backend.LIBRARY_VARIABLE, raising=False)
    monkeypatch.delenv(backend.VARIANT_VARIABLE, raising=False)


@pytest.fixture
def nothing_else(monkeypatch):
    """Leave nothing in reach but the variable's library."""
    monkeypatch.setattr(backend, "_packaged_library", lambda: None)
    monkeypatch.setattr(backend, "_system_libraries", lambda: [])
    monkeypatch.setattr(backend, "_drjit_loaded", lambda: False)


@pytest.fixture
def no_child(monkeypatch):
    """Count the child processes instead of starting them; each finds its library usable."""
    tried = []

    def run(path):
        tried.append(path)
        return "ok"

    monkeypatch.setattr(backend, "_run_probe", run)
    return tried


# The doctor ------------------------------------------------------------------------------------------------------


@pytest.mark.render
def test_doctor_says_that_it_renders_and_knows_variants(tmp_path):
    def doctor(**variables):
        command, environment = [sys.executable, "-c", MAIN, "doctor", "--json"], {**os.environ, **variables}
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)

    bad = str(tmp_path / "none.so")
    done = doctor(DRJIT_LIBLLVM_PATH=bad, SIMTEST_VARIANT="llvm_ad_rgb")
    assert (done.stderr, done.returncode) == ("", 0)
    report = json.loads(done.stdout)
    assert (report["can_render"], report["problem"], report["variant"]) == (True, None, "llvm_ad_rgb")
    assert Path(report["library"]).is_file()
    # A bad variable is reported, and passed over.
    assert report["candidates"][0] == {"origin": "DRJIT_LIBLLVM_PATH", "path": bad, "verdict": "no such file"}
    assert report["candidates"][-1]["verdict"] == "ok"
    assert set(report["versions"]) == {"mitsuba", "drjit"}
    # Bad input, as of every other command.
    done = doctor(SIMTEST_VARIANT="llvm_nope")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("simtest: SIMTEST_VARIANT 'llvm_nope': cannot be used; allowed: llvm, cuda, ")
    assert done.stderr.count("\n") == 1


# Bad libraries ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("nothing_else")
@pytest.mark.parametrize("name", BAD)
def test_a_bad_library_gives_its_own_message_and_three_ways_to_mend_it(here, name, monkeypatch, tmp_path):
    make, verdict = BAD[name]
    (tmp_path / "library").mkdir()
    library, place = make(tmp_path / "library"), tmp_path / "place"
    place.mkdir()
    monkeypatch.chdir(place)
    monkeypatch.setenv(backend.LIBRARY_VARIABLE, str(library))
    soft, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (hard, hard))
    try:
        tried = probe(candidates()[0])
    finally:
        resource.setrlimit(resource.RLIMIT_CORE, (soft, hard))
    assert verdict in tried.verdict
    assert "\n" not in tried.verdict
    assert not list(place.iterdir())

    code, output, errors = here("doctor")
    assert (code, errors) == (1, [])
    assert "rendering   does not work" in output
    for word in (str(library), verdict, "(1) pip install karellen-llvm-core", "(2) install", "(3) set DRJIT_LIBLLVM"):
        assert word in output

    code, output, errors = here("render", "plane", "--out", place)
    assert (code, output, len(errors)) == (1, "", 1)
    assert errors[0].startswith("simtest: no usable libLLVM: ")
    assert "(3) set DRJIT_LIBLLVM_PATH" in errors[0]
    assert not list(place.iterdir())

    with pytest.raises(BackendError, match="no usable libLLVM: ") as error:
        backend.load()
    assert verdict in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("nothing_else")
def test_no_library_at_all(monkeypatch):
    assert candidates() == []
    with pytest.raises(BackendError, match=r"no usable libLLVM: none found. To mend it: \(1\)"):
        backend.load()
    # Nothing to choose, and nothing changed.
    assert backend.LIBRARY_VARIABLE not in os.environ
    monkeypatch.setenv(backend.LIBRARY_VARIABLE, "")
    assert candidates() == []


def test_a_probe_that_hangs_is_given_up_and_not_remembered(monkeypatch, tmp_path):
    monkeypatch.setattr(backend, "PROBE_TIMEOUT_S", 0.01)
    library = file_of("x")(tmp_path)
    assert probe(Candidate("test", str(library))).verdict == "could not be tried (TimeoutExpired)"
    assert not backend._cache_file().exists()


# Candidates ------------------------------------------------------------------------------------------------------


def test_candidates_come_in_order_and_an_empty_variable_counts_as_unset(monkeypatch):
    monkeypatch.setattr(backend, "_packaged_library", lambda: "/packaged")
    monkeypatch.setattr(backend, "_system_libraries", lambda: ["/new", "/old"])
    others = [("pip package karellen-llvm-core", "/packaged"), ("system", "/new"), ("system", "/old")]
    assert [(c.origin, c.path) for c in candidates()] == others
    monkeypatch.setenv(backend.LIBRARY_VARIABLE, "")
    assert [(c.origin, c.path) for c in candidates()] == others
    assert backend.library_in_use() is None
    monkeypatch.setenv(backend.LIBRARY_VARIABLE, "/mine")
    assert [(c.origin, c.path) for c in candidates()] == [("DRJIT_LIBLLVM_PATH", "/mine"), *others]


def test_the_first_that_works_is_chosen_and_the_rest_is_not_tried(monkeypatch, tmp_path, no_child):
    first, second = tmp_path / "first.so", tmp_path / "second.so"
    for file in (first, second):
        file.write_text("x")
    monkeypatch.setattr(backend, "_packaged_library", lambda: str(tmp_path))
    monkeypatch.setattr(backend, "_system_libraries", lambda: [str(first), str(second)])
    chosen, tried = choose_library()
    assert chosen == Candidate("system", str(first), "ok")
    assert [candidate.verdict for candidate in tried] == ["is a folder; must be the file libLLVM.so itself", "ok"]
    assert no_child == [str(first)]


def test_libraries_that_are_found_are_files_and_each_comes_once():
    found = backend._system_libraries()
    assert len(set(found)) == len(found)
    packaged = backend._packaged_library()
    assert all(Path(path).is_file() for path in [*found, *([packaged] if packaged else [])])


# The cache -------------------------------------------------------------------------------------------------------


def test_a_verdict_is_kept_by_path_size_and_time(tmp_path, no_child):
    library = tmp_path / "library.so"
    library.write_text("one")
    os.utime(library, ns=(1, 1))
    assert probe(Candidate("test", str(library))).verdict == "ok"
    assert probe(Candidate("test", str(library))).verdict == "ok"
    assert len(no_child) == 1
    file = tmp_path / "cache" / "simtest" / "libllvm.json"
    (key,) = json.loads(file.read_text())
    assert key.startswith(f"{library}|3|1|drjit ")
    for change in (
        lambda: os.utime(library, ns=(2, 2)),
        lambda: (library.write_text("three"), os.utime(library, ns=(2, 2))),
        lambda: library.rename(tmp_path / "other.so"),
    ):
        before = len(no_child)
        change()
        path = next(path for path in (library, tmp_path / "other.so") if path.exists())
        probe(Candidate("test", str(path)))
        assert len(no_child) == before + 1
    assert [path.name for path in file.parent.iterdir()] == ["libllvm.json"]


def test_a_corrupt_cache_or_one_that_cannot_be_written_costs_only_time(tmp_path, no_child):
    library, file = file_of("x")(tmp_path), tmp_path / "cache" / "simtest" / "libllvm.json"
    file.parent.mkdir(parents=True)
    contents = [b"", b"{", b"[1, 2]", b'"text"', b"null", b"\xff\xfe\x00", b"{}"]
    for tried, content in enumerate(contents, start=1):
        file.write_bytes(content)
        assert probe(Candidate("test", str(library))).verdict == "ok"
        assert len(no_child) == tried
        assert list(json.loads(file.read_text()).values()) == ["ok"]
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "cache").write_text("a file where the folder should be")
    for _ in range(2):
        assert probe(Candidate("test", str(library))).verdict == "ok"
    assert len(no_child) == len(contents) + 2


# Variants --------------------------------------------------------------------------------------------------------


def test_the_variant_is_the_argument_or_the_variable_or_the_default(monkeypatch):
    assert requested_variant() == "llvm_ad_mono"
    for variable, used in (("", "llvm_ad_mono"), ("llvm_ad_rgb", "llvm_ad_rgb")):
        monkeypatch.setenv(backend.VARIANT_VARIABLE, variable)
        assert requested_variant() == used
    assert requested_variant("cuda_ad_mono") == "cuda_ad_mono"


def test_a_device_alone_has_as_many_channels_as_the_scene_needs(monkeypatch):
    for device in ("llvm", "cuda"):
        assert requested_variant(device) == f"{device}_ad_mono"
        assert requested_variant(device, coloured=True) == f"{device}_ad_rgb"
        assert colour_variant(device) == f"{device}_ad_rgb"
        monkeypatch.setenv(backend.VARIANT_VARIABLE, device)
        assert requested_variant(coloured=True) == f"{device}_ad_rgb"
        assert backend.needs_gpu() is (device == "cuda")
        assert backend.needs_llvm() is (device == "llvm")
        # A dataset has three channels unless its own option names the variant whole; the variable names the device.
        for told in (device, f"{device}_ad_mono", f"{device}_ad_rgb"):
            monkeypatch.setenv(backend.VARIANT_VARIABLE, told)
            assert colour_variant() == f"{device}_ad_rgb"
    monkeypatch.delenv(backend.VARIANT_VARIABLE)
    assert colour_variant() == "llvm_ad_rgb"
    assert colour_variant("llvm_ad_mono") == "llvm_ad_mono"
    assert not backend.needs_gpu("llvm_ad_rgb")
    assert backend.needs_gpu("cuda_ad_mono")


def test_unknown_variants_name_the_allowed_ones(monkeypatch):
    unknown = ["nope", "scalar_mono", "LLVM_AD_MONO", "scalar_rgb", "llvm_ad_spectral"]
    for name, given in [*zip(unknown, unknown, strict=True), *((name, None) for name in unknown)]:
        monkeypatch.setenv(backend.VARIANT_VARIABLE, name)
        with pytest.raises(InputError) as error:
            backend.load(given)
        text = str(error.value)
        named = "variant" if given else backend.VARIANT_VARIABLE
        assert text.startswith(f"{named} '{name}': cannot be used; allowed: ")
        assert "llvm_ad_mono" in text
        assert "cuda_ad_mono" in text
        assert "\n" not in text


@pytest.mark.parametrize("first", [pytest.param("nope", marks=pytest.mark.ci), "cuda_ad_mono"])
def test_a_variant_that_fails_leaves_the_next_one_usable(first):
    """Dr.Jit loads its libLLVM when it is imported, and that must not be one that ends the process."""
    code = (
        "from simtest.errors import SimtestError; from simtest.rendering import backend\n"
        f"try: backend.load({first!r})\n"
        "except SimtestError: pass\n"
        "mi = backend.load('llvm_ad_mono'); import drjit as dr\n"
        "assert dr.sum(dr.maximum(dr.arange(mi.Float, 5), 2))[0] == 13"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, env={**os.environ})


def test_a_bad_library_in_memory_is_refused(monkeypatch, tmp_path):
    # The choice itself is made first: what follows only pretends that there was none.
    backend.load("llvm_ad_mono")
    library = tmp_path / "libLLVM.so.15"
    library.write_bytes(b"no library")
    monkeypatch.setattr(backend, "_drjit_loaded", lambda: True)
    monkeypatch.setattr(backend, "_chosen", set())
    monkeypatch.setattr(backend, "_mapped_libraries", lambda: [str(library)])
    with pytest.raises(BackendError, match=f"libLLVM {library}, loaded before simtest could choose: .* before drjit"):
        backend.load("llvm_ad_mono")
    monkeypatch.setattr(backend, "_run_probe", lambda path: "ok")
    monkeypatch.setattr(backend, "_read_cache", lambda: {})
    backend.load("llvm_ad_mono")


def test_another_library_in_memory_beside_the_chosen_one_does_no_harm(monkeypatch):
    """A viewer's software renderer may bring an older one after simtest has made its choice."""
    backend.load("llvm_ad_mono")
    monkeypatch.setattr(backend, "_mapped_libraries", lambda: ["/usr/lib/libLLVM-15.so.1"])
    monkeypatch.setattr(backend, "_run_probe", lambda path: "aborts")
    backend.load("llvm_ad_mono")


# Importing -------------------------------------------------------------------------------------------------------


def test_nothing_is_set_or_loaded_at_import():
    code = (
        "import cv2, os, sys; before = dict(os.environ)\n"  # OpenCV sets LD_LIBRARY_PATH
        "import simtest.rendering.backend, simtest.rendering.session\n"
        "assert dict(os.environ) == before\n"
        "assert not {'mitsuba', 'drjit'} & set(sys.modules), 'loaded'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_one_thread_writes_a_picture(tmp_path):
    """OpenEXR once waited for ever for a second thread."""
    code = (
        "import sys, numpy as np; from pathlib import Path\n"
        "from simtest.rendering.bitmap import read_bitmap, write_exr\n"
        "write_exr(Path(sys.argv[1]), np.ones((8, 9), dtype=np.float32))\n"
        "import drjit; print(read_bitmap(Path(sys.argv[1])).shape, drjit.thread_count())"
    )
    environment = {**os.environ, "SIMTEST_THREADS": "1"}
    command = [sys.executable, "-c", code, str(tmp_path / "a.exr")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split(")")[1].strip() == "1"


@pytest.mark.parametrize("home", ["read-only", None])
@pytest.mark.parametrize("others", [False, True])
def test_a_home_that_cannot_be_written_is_no_news(tmp_path, home, others):
    """Dr.Jit said so in a line of its own, in each process, also with --quiet."""
    kept = tmp_path / f"simtest-kernels-{os.getuid()}"
    (tmp_path / "home").write_text("")
    environment = {**os.environ, "TMPDIR": str(tmp_path)} | ({"HOME": str(tmp_path / "home")} if home else {})
    if home is None:
        environment.pop("HOME", None)
    if others:
        # Compiled code in a folder that others can write to is not run.
        kept.mkdir(mode=0o777)
        kept.chmod(0o777)
    code = "from simtest.rendering import backend; backend.load('llvm')"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stderr.count("jit_init") == others
    assert others or oct(kept.stat().st_mode & 0o777) == "0o700"
