"""Stop `validate`, `dataset` and `nightly` by kill -9, SIGTERM and full disks; the same command must mend everything.

`python -m studies.kills` disturbs each command 30, 10 and 10 times, and kills a worker of it 5 times; `--command` names
one of them. After some disturbances the command runs undisturbed, and what it has made is compared byte by byte with an
undisturbed run's.
"""

import argparse
import contextlib
import json
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.measuring import Figure, print_figures
from simtest.runtime.provenance import file_hash

DISTURBANCES = {"kill": 30, "term": 10, "full": 10, "worker": 5}
BETWEEN = 4
"""At most so many disturbances come before the command runs undisturbed."""

TERMINATED = 143
EXPERIMENT = """realisations = 250
[[groups]]
scene = "published"
sweep = [{ "paper.eps" = [0.0, 0.02, 0.05, 0.1] }]
[[groups]]
scene = "plane"
realisations = 4
set = { "camera.width" = 64, "camera.height" = 48, "camera.fx" = 48.0, "camera.fy" = 48.0 }
sweep = [{ "surface.tilt_deg" = [0, 3, 6, 9, 12] }]
"""
PROFILE = """[[experiments]]
experiment = "x.toml"
realisations = 40
"""
_RUN = "from simtest.cli.main import main; main()"


@dataclass(frozen=True)
class Target:
    """A command, its arguments but for the folder, and what of its files is compared."""

    arguments: tuple[str, ...]
    contents: Callable[[Path], dict[str, str]]
    own_scratch: tuple[str, ...] = ()
    """Patterns of names that a run makes and removes again: none may be left."""


@dataclass
class Tally:
    """What was seen."""

    done: Counter[str] = field(default_factory=Counter)
    hit: Counter[str] = field(default_factory=Counter)
    differing: int = 0
    left: int = 0
    orphans: int = 0
    unclear: int = 0


def _all_files(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): file_hash(path) for path in folder.rglob("*") if path.is_file()}


def _run_files(folder: Path) -> dict[str, str]:
    """Return hashes of a run's files; of its summary and page, which tell the time, that they are there and whole."""
    held = _all_files(folder)
    if "summary.json" in held:
        summary = json.loads((folder / "summary.json").read_text())
        held["summary.json"] = json.dumps(summary["experiments"], sort_keys=True)
        page = (folder / "index.html").read_text(encoding="utf-8") if "index.html" in held else ""
        held["index.html"] = str(page.rstrip().endswith("-->") or page.rstrip().endswith("</html>"))
    return held


def _night_files(folder: Path) -> dict[str, str]:
    """Return hashes of the last night's tables, and the names of its files."""
    last = folder / "nightly" / "p"
    if not last.is_dir():
        return {}
    held = dict.fromkeys(sorted(path.name for path in last.iterdir()), "")
    return held | {name: file_hash(last / name) for name in ("rows.parquet", "figures.parquet") if name in held}


TARGETS = {
    "validate": Target(
        ("validate", "x.toml", "--workers", "2", "--out"), _run_files, ("**/.*.part*", "**/.lock", "parts"),
    ),
    "dataset": Target(
        ("dataset", "tiny", "--samples", "24", "--set", "samples_per_anatomy=4", "--set", "shard_mb=0.1",
         "--workers", "2", "--out"), _all_files, ("*.part*", ".*.part*", ".lock"),
    ),
    "nightly": Target(
        ("nightly", "--profile", "p.toml", "--workers", "2", "--reports"), _night_files,
        ("work/*", "**/.*.part*", ".p.lock", "nightly/.p.old"),
    ),
}  # fmt: skip


def disturb(name: str, counts: dict[str, int], log: Callable[[str], None]) -> list[Figure]:
    """Disturb a command; return how often its files differed from an undisturbed run's, and what was left."""
    target, rng, tally = TARGETS[name], random.Random(name), Tally()
    with tempfile.TemporaryDirectory() as scratch, _disk(Path(scratch) / "disk") as (disk, resize):
        cwd = Path(scratch)
        (cwd / "x.toml").write_text(EXPERIMENT)
        (cwd / "p.toml").write_text(PROFILE)
        # An undisturbed run: its files, time and size
        whole, begun = cwd / "whole", time.monotonic()
        _finish(target, whole, cwd)
        took, wanted = time.monotonic() - begun, target.contents(whole)
        size = sum(path.stat().st_size for path in whole.rglob("*") if path.is_file())
        kinds = [kind for kind, count in counts.items() for _ in range(count)]
        rng.shuffle(kinds)
        while kinds:
            folder = disk / "cut"
            shutil.rmtree(folder, ignore_errors=True)
            for _ in range(min(BETWEEN, len(kinds))):
                kind = kinds.pop()
                resize(size * rng.uniform(0.02, 1.1) if kind == "full" else None)
                code, how = _disturbed(target, folder, cwd, kind, rng.uniform(0.1, 1.0) * took, tally)
                resize(None)
                tally.done[kind] += 1
                tally.hit[kind] += code != 0
                log(f"{name}: {kind}: {how}")
                # It was done before it was stopped: the next disturbance begins anew.
                if code == 0:
                    break
            _finish(target, folder, cwd)
            different = set(wanted.items()) ^ set(target.contents(folder).items())
            left = [str(path.relative_to(folder)) for pattern in target.own_scratch for path in folder.glob(pattern)]
            tally.differing += len(different)
            tally.left += len(left)
            if different or left:
                log(f"{name}: differing {sorted(different)[:4]}, left {left[:4]}")
    about = ", ".join(f"{tally.done[kind]} {kind} ({tally.hit[kind]} hit)" for kind in counts)
    return [
        Figure(f"{name}: files that differ from an undisturbed run's", tally.differing, 0, unit="", about=about),
        Figure(f"{name}: files left behind", tally.left, 0, unit="", about=about),
        Figure(f"{name}: processes left behind", tally.orphans, 0, unit="", about=about),
        Figure(f"{name}: ends without one clear line", tally.unclear, 0, unit="", about=about),
    ]


def _disturbed(target: Target, folder: Path, cwd: Path, kind: str, after_s: float, tally: Tally) -> tuple[int, str]:
    """Run a command and stop it after a time, or let it meet the full disk; return its exit code and how it ended."""
    process = _start(target, folder, cwd)
    if kind == "full":
        _, errors = process.communicate()
    else:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        children = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        if kind == "worker":
            # The run goes on without it.
            workers = [child for child in children if _is_worker(child)]
            for worker in workers[:1]:
                worker.kill()
        else:
            process.send_signal(signal.SIGKILL if kind == "kill" else signal.SIGTERM)
        _, errors = process.communicate()
        # Workers notice that their parent has gone.
        _, alive = psutil.wait_procs(children, timeout=20)
        tally.orphans += len(alive)
    lines = [line for line in errors.splitlines() if line.startswith("simtest: ") and "warning" not in line]
    code = process.returncode
    clear = {"kill": code in (0, -9), "term": code in (0, TERMINATED), "full": code in (0, 1, 2), "worker": code == 0}[
        kind
    ]
    # Before main listens, SIGTERM ends a process as it ends any.
    early = kind == "term" and code == -signal.SIGTERM
    if not early and (not clear or (code > 0 and (len(lines) != 1 or "internal error" in lines[0]))):
        tally.unclear += 1
    return code, f"exit {code}{f': {lines[-1][:200]}' if lines else ''}"


def _is_worker(child: psutil.Process) -> bool:
    with contextlib.suppress(psutil.Error):
        return any("spawn_main" in word for word in child.cmdline())
    return False


def _start(target: Target, folder: Path, cwd: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", _RUN, *target.arguments, str(folder)]
    return subprocess.Popen(command, cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def _finish(target: Target, folder: Path, cwd: Path) -> None:
    process = _start(target, folder, cwd)
    _, errors = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(f"exit {process.returncode}: {errors[-500:]}")


@contextlib.contextmanager
def _disk(path: Path) -> Iterator[tuple[Path, Callable[[float | None], None]]]:
    """Make a folder, and a function that sets how many bytes fit there; None for no limit.

    A small disk in memory where that may be mounted, else a limit of the size of single files.
    """
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1g", "tmpfs", str(path)]
    mounted = subprocess.run(mount, capture_output=True).returncode == 0

    def resize(size: float | None) -> None:
        if mounted:
            used = sum(file.stat().st_blocks * 512 for file in path.rglob("*") if file.is_file())
            most = 1 << 30 if size is None else int(max(size, used + 4096))
            subprocess.run(["mount", "-o", f"remount,size={most}", path], check=True)
        else:
            soft = resource.RLIM_INFINITY if size is None else int(size / 4)
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, resource.RLIM_INFINITY))

    try:
        yield path, resize
    finally:
        resize(None)
        if mounted:
            subprocess.run(["umount", path], check=True)


def main() -> int:
    """Disturb the commands and print the figures; exit 1 where one misses its limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--command", choices=list(TARGETS), action="append", help="default all")
    parser.add_argument("--share", type=float, default=1.0, help="of the disturbances")
    parser.add_argument("--log", type=Path, help="file that gets a line for each disturbance")
    given = parser.parse_args()
    counts = {kind: max(1, round(given.share * count)) for kind, count in DISTURBANCES.items()}

    def log(text: str) -> None:
        if given.log:
            with given.log.open("a") as file:
                file.write(text + "\n")

    return print_figures([f for name in given.command or TARGETS for f in disturb(name, counts, log)])


if __name__ == "__main__":
    sys.exit(main())
