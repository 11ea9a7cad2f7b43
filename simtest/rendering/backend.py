"""Chooses the rendering backend: which libLLVM Dr.Jit loads and which Mitsuba variant runs.

A bad libLLVM can abort the process at its first kernel, so each candidate compiles and runs a small kernel in a
child process before the real one uses it. Nothing is set when this module is imported.
"""

import contextlib
import gc
import importlib
import importlib.metadata
import json
import os
import re
import signal
import stat
import subprocess
import sys
import tempfile
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from simtest.errors import BackendError, InputError
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import Json, user_cache, write_json
from simtest.runtime.messages import LOGGER


class _Late:
    """A module that is imported when an attribute of it is first asked for: `load` chooses its library before."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        # Looked up each time: what a variant is made of changes with it.
        return getattr(sys.modules.get(self._name) or importlib.import_module(self._name), name)


dr: Any = _Late("drjit")
mi: Any = _Late("mitsuba")
"""With the variant that `load` has set last, or the session that is at work."""

LLVM, CUDA = DEVICES = ("llvm", "cuda")
"""What kernels are compiled for: the processor, or an NVIDIA GPU. Nothing outside this module names a variant."""

VARIANTS = tuple(f"{device}_ad_{channels}" for device in DEVICES for channels in ("mono", "rgb"))
"""Mitsuba's variants that can be used; which of them it has been built with is known once it is imported."""

DEFAULT_VARIANT = f"{LLVM}_ad_mono"
COLOUR_VARIANT = f"{LLVM}_ad_rgb"
LIBRARY_VARIABLE, CACHE_VARIABLE = "DRJIT_LIBLLVM_PATH", "DRJIT_CACHE_DIR"
VARIANT_VARIABLE = "SIMTEST_VARIANT"
PIP_PACKAGE = "karellen-llvm-core"
PROBE_TIMEOUT_S = 120

UNTRIED = "could not be tried"
"""Beginning of a verdict on the attempt, not on the library (no time, no memory): it is not cached."""

# The kernel holds a `max`: libLLVM 15 compiles everything up to it and then aborts the process.
_PROBE = """
import resource, sys
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
import drjit as dr
from drjit.llvm import Float
x = dr.arange(Float, 64)
dr.make_opaque(x)
assert dr.allclose(dr.maximum(x, 3) + dr.minimum(x, 3), x + 3)
print("simtest-probe-ok")
"""

MENDING = (
    f"(1) pip install {PIP_PACKAGE} (Linux x86-64), or (2) install the system's LLVM 19 or newer, "
    f"or (3) set {LIBRARY_VARIABLE} to the file libLLVM.so of LLVM 19 or newer"
)


@dataclass(frozen=True)
class Candidate:
    """A libLLVM that might be used."""

    origin: str  # Where it was found
    path: str  # The file
    verdict: str = ""  # "ok", or why it cannot be used; empty while untried


def requested_variant(variant: str | None = None, coloured: bool = False) -> str:
    """Return the Mitsuba variant: the argument, else the environment's SIMTEST_VARIANT, else the default.

    A device alone (see `DEVICES`, the default is the processor) is its variant of one channel, or of three where the
    scene is `coloured`. Raises `InputError` for a name that is no variant's.
    """
    if variant is not None and not variant.strip():
        raise InputError(f"--variant is empty; must be one of {', '.join((*DEVICES, *VARIANTS))}")
    name = variant or os.environ.get(VARIANT_VARIABLE) or LLVM
    if name not in (*DEVICES, *VARIANTS):
        allowed = (*DEVICES, *VARIANTS)
        meant = suggestion(name, allowed)
        given = "variant" if variant else VARIANT_VARIABLE
        raise InputError(f"{given} {name!r}: cannot be used; allowed: {', '.join(allowed)}{meant}")
    return f"{name}_ad_{'rgb' if coloured else 'mono'}" if name in DEVICES else name


def colour_variant(variant: str | None = None) -> str:
    """Return the variant of frames in colour: three channels, unless `variant` names it whole.

    Without one, the device is that of the environment's SIMTEST_VARIANT.
    """
    name = requested_variant(variant, coloured=True)
    return name if variant else name.replace("_mono", "_rgb")


def needs_gpu(variant: str | None = None) -> bool:
    """Return whether a variant (see `requested_variant`) runs on a GPU."""
    return requested_variant(variant).startswith(CUDA)


def needs_llvm(variant: str | None = None) -> bool:
    """Return whether a variant (see `requested_variant`) needs a libLLVM."""
    return requested_variant(variant).startswith(LLVM)


def candidates() -> list[Candidate]:
    """List the libraries in the order they are tried: the variable, the pip package's, the system's newest."""
    # The user's choice, then the tested package, then whatever the system has.
    libraries = []
    if variable := os.environ.get(LIBRARY_VARIABLE):
        libraries.append(Candidate(LIBRARY_VARIABLE, variable))
    if packaged := _packaged_library():
        libraries.append(Candidate(f"pip package {PIP_PACKAGE}", packaged))
    libraries += [Candidate("system", path) for path in _system_libraries()]
    return libraries


def _packaged_library() -> str | None:
    try:
        files = importlib.metadata.files(PIP_PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if re.fullmatch(r"libLLVM\.so\.\d+\.\d+", file.name):
            return str(Path(str(file.locate())).resolve())
    return None


def _system_libraries() -> list[str]:
    """Return the system's libLLVM files, the newest version first, each file once."""
    folders = ["/usr/lib", "/usr/lib64", "/usr/local/lib", *map(str, Path("/usr/lib").glob("*-linux-gnu"))]
    folders += map(str, Path("/usr/lib").glob("llvm-*/lib"))
    versions: dict[str, tuple[int, ...]] = {}
    # File names tell the version: libLLVM-19.so.1, libLLVM.so.19.1.
    for folder in folders:
        for path in Path(folder).glob("libLLVM*.so*"):
            if match := re.fullmatch(
                r"libLLVM(?:-(\d+))?\.so(?:\.([\d.]+))?|libLLVM-([\d.]+)\.so(?:\.\d+)?", path.name
            ):
                numbers = next((group for group in match.groups() if group), "0")
                version = tuple(int(part) for part in numbers.strip(".").split("."))
                resolved = str(path.resolve())
                versions[resolved] = max(version, versions.get(resolved, (0,)))
    return sorted(versions, key=lambda path: versions[path], reverse=True)


def probe(candidate: Candidate) -> Candidate:
    """Try a library in a child process; return it with the verdict, cached per file (path, size, time of change)."""
    # Paths that need no child process.
    path = Path(candidate.path)
    if path.is_dir():
        verdict = "is a folder; must be the file libLLVM.so itself"
    elif not path.is_file():
        verdict = "no such file"
    else:
        status = path.stat()
        versions = importlib.metadata.version("drjit")
        key = f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}|drjit {versions}"
        cache = _read_cache()
        verdict = cache.get(key) or _run_probe(str(path))
        if cache.get(key) != verdict and not verdict.startswith(UNTRIED):
            _write_cache({**cache, key: verdict})
    return replace(candidate, verdict=verdict)


def _run_probe(path: str) -> str:
    environment = {**os.environ, LIBRARY_VARIABLE: path}
    try:
        child = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{UNTRIED} ({type(error).__name__})"
    if "simtest-probe-ok" in child.stdout:
        return "ok"
    # Aborted: too old. Another signal: nothing is known. Else its own message.
    lines = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    if child.returncode == -signal.SIGABRT:
        return "aborts the process when a kernel is compiled; too old for Dr.Jit"
    if child.returncode < 0:
        return f"{UNTRIED} (signal {-child.returncode} ended the attempt)"
    said = next((line for line in lines if "LLVM" in line and "Traceback" not in line), lines[-1] if lines else "")
    return f"is not a usable libLLVM ({said[:160]})"


def _cache_file() -> Path:
    kept = user_cache()
    if kept is None:
        raise FileNotFoundError("this user has no home")
    return kept / "libllvm.json"


def _read_cache() -> dict[str, str]:
    try:
        cache = json.loads(_cache_file().read_text())
    except (OSError, ValueError):
        return {}
    items = cache.items() if isinstance(cache, dict) else ()
    return {key: verdict for key, verdict in items if isinstance(verdict, str)}


def _write_cache(cache: dict[str, str]) -> None:
    """Store the verdicts; a cache that cannot be written costs only time."""
    with contextlib.suppress(OSError):
        _cache_file().parent.mkdir(parents=True, exist_ok=True)
        write_json(_cache_file(), cache)


def choose_library() -> tuple[Candidate | None, list[Candidate]]:
    """Try the candidates in order; return the first that works, if any, and all that were tried, with verdicts."""
    tried = []
    for candidate in candidates():
        tried.append(probe(candidate))
        if tried[-1].verdict == "ok":
            return tried[-1], tried
    return None, tried


def load(variant: str | None = None) -> Any:
    """Return the mitsuba module with its variant set; every use of the renderer goes through here.

    Parameters
    ----------
    variant : str, optional
        Such as "llvm_ad_mono" or "cuda_ad_mono", or a device; see `requested_variant`.

    Returns
    -------
    module
        mitsuba.
    """
    name = requested_variant(variant)
    # Library: chosen before Dr.Jit is imported, checked afterwards.
    if _drjit_loaded():
        if needs_llvm(name):
            _check_library_in_memory()
    else:
        _set_library(needed=needs_llvm(name))
        _set_kernel_cache()
    import mitsuba

    # Variant.
    usable = [v for v in mitsuba.variants() if v in VARIANTS]
    if name not in usable:
        raise BackendError(f"variant {name!r}: cannot be used; allowed: {', '.join((*DEVICES, *usable))}")
    if mitsuba.variant() != name:
        try:
            mitsuba.set_variant(name)
            if threads := os.environ.get("SIMTEST_THREADS"):
                _limit_threads(threads)
            # Use it once: without a GPU a GPU variant fails here, not when it is set.
            mitsuba.Float(0.0) + 1.0
        except (ImportError, RuntimeError) as error:
            cause = "no usable NVIDIA GPU" if needs_gpu(name) else str(error).splitlines()[0]
            raise BackendError(f"variant {name}: cannot be used here ({cause})") from error
    return mitsuba


def release_memory() -> None:
    """Free the memory of scenes that are gone: Dr.Jit keeps freed arrays for the next ones."""
    import drjit

    gc.collect()
    drjit.flush_malloc_cache()


def _limit_threads(threads: str) -> None:
    if not threads.isdecimal() or not 1 <= int(threads) <= 1024:
        raise InputError(f"SIMTEST_THREADS = {threads!r}: must be a number of threads, 1 to 1024")
    import drjit

    drjit.set_thread_count(int(threads))


def _drjit_loaded() -> bool:
    """Return whether Dr.Jit has been imported and has loaded its libLLVM, so that nothing is left to choose."""
    return "drjit" in sys.modules


def _set_library(needed: bool) -> None:
    """Set the libLLVM that Dr.Jit loads, whatever the variant: it does so once, when it is imported."""
    chosen, tried = choose_library()
    if chosen is None:
        if needed:
            raise BackendError(no_library_message(tried))
        return
    for failed in tried[:-1]:
        if failed.origin == LIBRARY_VARIABLE:
            warnings.warn(f"{LIBRARY_VARIABLE}={failed.path}: {failed.verdict}; using {chosen.path}", stacklevel=3)
    LOGGER.debug("libLLVM is %s (%s)", chosen.path, chosen.origin)
    os.environ[LIBRARY_VARIABLE] = chosen.path
    _chosen.add(chosen.path)


_chosen: set[str] = set()
"""The library that this process chose for Dr.Jit, once it did."""


def _set_kernel_cache() -> None:
    """Let Dr.Jit keep its kernels in a folder of this user's among the temporary ones, where it can keep none at home.

    Each process would otherwise complain in a line of its own, whatever its user wants to hear.
    """
    home = Path(os.environ.get("HOME") or "/nonexistent")
    kept = home / ".drjit" if (home / ".drjit").is_dir() else home
    if CACHE_VARIABLE in os.environ or os.access(kept, os.W_OK | os.X_OK):
        return
    folder = Path(tempfile.gettempdir(), f"simtest-kernels-{os.getuid()}")
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        # Compiled code is run: nobody else may have made it.
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            os.environ[CACHE_VARIABLE] = str(folder)


def _check_library_in_memory() -> None:
    """Raise `BackendError` if something else made Dr.Jit load a libLLVM that would end the process.

    Where simtest chose the library, others may be in memory too: Mesa's software renderer brings its own.
    """
    if _chosen:
        return
    for path in _mapped_libraries():
        verdict = probe(Candidate("in memory", path)).verdict
        if verdict != "ok":
            raise BackendError(
                f"libLLVM {path}, loaded before simtest could choose: {verdict}; import simtest's renderer (or call "
                "simtest.render) before drjit or mitsuba"
            )


def _mapped_libraries() -> list[str]:
    """Return the libLLVM files that are mapped into this process; none where the system does not list them."""
    try:
        maps = Path("/proc/self/maps").read_text()
    except OSError:
        return []
    return sorted(set(re.findall(r"/\S*libLLVM[^/\s]*\.so\S*", maps)))


def library_in_use() -> str | None:
    """Return the libLLVM that this process was told to use, or None."""
    return os.environ.get(LIBRARY_VARIABLE) or None


def no_library_message(tried: list[Candidate]) -> str:
    """Return one line: why no library works, and the three ways to mend it."""
    causes = "; ".join(f"{c.path} ({c.origin}): {c.verdict}" for c in tried) or "none found"
    return f"no usable libLLVM: {causes}. To mend it: {MENDING}"


@dataclass(frozen=True)
class BackendReport:
    """State of the backend, as `simtest doctor` reports it."""

    variant: str  # Mitsuba variant
    library: str | None  # The libLLVM that would be used
    candidates: list[Candidate]  # Libraries that were tried, with verdicts
    versions: dict[str, str]  # Version by package
    problem: str | None  # Why it cannot render, one line

    @property
    def can_render(self) -> bool:
        """Whether no problem was found."""
        return self.problem is None

    def to_json(self) -> Json:
        """Return what `simtest doctor --json` prints."""
        return {**asdict(self), "can_render": self.can_render}


RENDER_TIMEOUT_S = 180


def examine(variant: str | None = None) -> BackendReport:
    """Examine the rendering backend (see `simtest.rendering.backend.requested_variant`); this process loads nothing."""
    versions = {package: importlib.metadata.version(package) for package in ("mitsuba", "drjit")}
    name = requested_variant(variant)
    chosen, tried = choose_library() if needs_llvm(name) else (None, [])
    lacking = needs_llvm(name) and chosen is None
    problem = no_library_message(tried) if lacking else _try_rendering(name)
    return BackendReport(name, chosen.path if chosen else None, tried, versions, problem)


def _try_rendering(variant: str) -> str | None:
    """Render a plane in a child process; return the problem, or None."""
    # A child: a bad libLLVM may end the process.
    # -P: no file of the current folder may stand in for a package.
    command = [sys.executable, "-P", "-m", "simtest.rendering.backend", variant]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"rendering a small scene took more than {RENDER_TIMEOUT_S} s"
    if child.returncode == 0:
        return None
    if child.returncode < 0:
        return f"rendering a small scene ended the process (signal {-child.returncode}). To mend it: {MENDING}"
    lines = [line for line in (child.stdout + child.stderr).splitlines() if line.strip()]
    return lines[-1] if lines else f"rendering a small scene ended with exit code {child.returncode}"


def _main() -> int:
    from simtest.errors import SimtestError
    from simtest.rendering.session import Session
    from simtest.spec import scene_from_dict

    scene = scene_from_dict({"surface": {"type": "plane"}, "camera": {"width": 17, "height": 17, "fx": 17, "fy": 17}})
    try:
        peak = float(Session(scene, sys.argv[1]).radiance().total.max())
    except SimtestError as error:
        print(json.dumps(str(error))[1:-1])
        return 1
    # At 10 mm the peak of a Phong plane of scale 1 is 1/100.
    return 0 if abs(peak - 0.01) < 1e-3 else 1


if __name__ == "__main__":
    sys.exit(_main())
