"""Ask canaries, and then the gate, about each mutant; a line of JSON for each answer, from which a later call goes on.

Each line states the code and the profile that it holds for. Lines of other code, or of another profile, are left out.

A few mutants at a time share a process, one after the other, with the package's caches emptied between them. Unchanged
code must raise no alarm after them; else each of them is asked again in a process of its own, as the gate's nights are.
"""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import simtest
from simtest.runtime.provenance import source_hash, versions
from simtest.runtime.resources import data_root
from studies.mutants.catalogue import BY_NAME, UNCHANGED
from studies.mutants.kinds import QUANTITIES, naming
from studies.mutants.mutant import Mutant

LIMIT_S = {"canaries": 900, "night": 7200}
"""A mutant may hang; its time is up after as many seconds of the clock."""

BATCH = 8
"""Mutants whose canaries are asked in one process: to start one takes longer than to ask."""

Answers = dict[tuple[str, str], dict[str, Any]]
"""What was found, by mutant and stage."""


@dataclass(frozen=True)
class Judged:
    """What saw a mutant.

    Parameters
    ----------
    mutant : Mutant
        The fault.
    naming : list of str
        Canaries that failed and name it.
    others : list of str
        Other canaries that failed.
    worse : list of str or None
        Quantities that the gate calls worse and that name it; None where the gate was not asked.
    alarms : list of str
        All quantities that the gate calls worse, whatever they name.
    stopped : str
        Why the canaries, or the gate, could not be asked; empty where they were.
    """

    mutant: Mutant
    naming: list[str]
    others: list[str]
    worse: list[str] | None
    alarms: list[str]
    stopped: str

    @property
    def by_name(self) -> bool:
        """Whether somebody named it."""
        return bool(self.naming or self.worse)

    @property
    def is_seen(self) -> bool:
        """Whether anybody raised an alarm."""
        return bool(self.naming or self.others or self.alarms or self.stopped)

    @property
    def as_wanted(self) -> bool:
        """Whether a fault was named, or unchanged code raised no alarm of any kind."""
        return not self.is_seen if self.mutant is UNCHANGED else self.by_name


@cache
def code_hash() -> str:
    """Return a hash of what answers hang on: simtest, its scenes, package versions, the mutants and who names them."""
    mutants = Path(__file__).parent
    files = [*mutants.glob("*.py"), mutants.parent / "gate" / "faults.py"]
    files += [*Path(simtest.__file__).parent.rglob("*.json"), *data_root("scenes").rglob("*.toml")]
    digest = hashlib.sha256((source_hash() + json.dumps(versions())).encode())
    for path in sorted(files):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def stamp(profile: str) -> dict[str, str]:
    """Return what each line states beside its answer: the code, and the profile of nights (canaries have none)."""
    path = Path(profile).expanduser()
    # Of a profile in a file the content counts.
    key = f"{path.stem} {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}" if path.is_file() else profile
    return {"source": code_hash(), "profile": key}


def read(file: Path, profile: str = "") -> Answers:
    """Read the answers of earlier calls about today's code: those of canaries, and those by nights of a profile.

    A line that a kill cut short is left out.
    """
    found: Answers = {}
    source, profiles = code_hash(), ("", stamp(profile)["profile"])
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else ():
        try:
            answer = json.loads(line)
        except json.JSONDecodeError:
            continue
        if answer.get("source") == source and answer.get("profile") in profiles:
            found[answer["name"], answer["stage"]] = answer
    return found


def ask(
    names: Iterable[str], stage: str, file: Path, workers: int, told: Callable[[str], None], profile: str = ""
) -> Answers:
    """Ask about all mutants that the file has no answer of, and add the answers to it; return all that hold today."""
    known = read(file, profile)
    open_ = [name for name in names if (name, stage) not in known]
    size = BATCH if stage == "canaries" else 1
    batches = [open_[first : first + size] for first in range(0, len(open_), size)]
    file.parent.mkdir(parents=True, exist_ok=True)
    done = 0
    with ThreadPoolExecutor(workers) as threads, file.open("a", encoding="utf-8") as out:
        if out.tell() and not file.read_text(encoding="utf-8").endswith("\n"):
            out.write("\n")
        for answers in threads.map(lambda batch: _asked(batch, stage, file, profile), batches):
            out.writelines(json.dumps({**answer, **stamp(profile)}) + "\n" for answer in answers)
            out.flush()
            done += len(answers)
            told(f"{stage} {done}/{len(open_)}")
    return read(file, profile)


def night_folder(file: Path, profile: str) -> Path:
    """Return the folder of the unchanged night, beside the answers; other code or another profile has another."""
    own = stamp(profile)
    digest = hashlib.sha256(json.dumps(own).encode()).hexdigest()[:16]
    return file.with_suffix(f".{Path(own['profile']).name or 'canaries'}.{digest}.night")


def _asked(names: list[str], stage: str, file: Path, profile: str) -> list[dict[str, Any]]:
    """Return the answers about some mutants that share a process.

    Where it ends early, or unchanged code fails a canary after them, each is asked again in a process of its own.
    """
    command = [sys.executable, "-m", "studies.mutants.child", stage, str(night_folder(file, profile)), profile, *names]
    environment = {**os.environ}
    if any(BY_NAME[name].spoils_kept_arrays for name in names):
        # What is kept for later processes must not hold the fault, nor hide it.
        environment["SIMTEST_CACHE"] = "off"
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S[stage], env=environment)
        lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        stopped = f"exit {done.returncode}: {(done.stderr.strip().splitlines() or ['no output'])[-1]}"
    except subprocess.TimeoutExpired:
        lines, stopped = [], f"no answer after {LIMIT_S[stage]} s"
    if len(names) == 1:
        return lines or [{"name": names[0], "stage": stage, "stopped": stopped}]
    if lines and lines[-1].get("control") == []:
        return lines[:-1]
    return [answer for name in names for answer in _asked([name], stage, file, profile)]


def judged(answers: Answers, names: Iterable[str]) -> Iterator[Judged]:
    """Yield who saw each mutant that the canaries were asked about."""
    for name in names:
        found, night = answers.get((name, "canaries")), answers.get((name, "night"))
        if found is None:
            continue
        mutant = BY_NAME[name]
        failed = [canary for canary, *_ in found.get("failed", ())]
        named = naming(mutant.kind, failed)
        others = [canary for canary in dict.fromkeys(failed) if canary not in named]
        worse, alarms, stopped = None, [], found.get("stopped", "")
        if night is not None:
            told = QUANTITIES.get(mutant.kind, ())
            pairs = night.get("worse", ())
            worse = [
                f"{where} {what}" for where, what in pairs if what in told or where in naming(mutant.kind, [where])
            ]
            alarms = [f"{where} {what}" for where, what in pairs]
            stopped = stopped or night.get("stopped", "")
        yield Judged(mutant, named, others, worse, alarms, stopped)


def run(
    names: Iterable[str], file: Path, workers: int, told: Callable[[str], None], profile: str | None = "quick"
) -> list[Judged]:
    """Ask the canaries about all mutants, and the gate about those that they do not name, by nights of a profile.

    Without a profile the gate is not asked.
    """
    names = list(dict.fromkeys([UNCHANGED.name, *names]))
    answers = ask(names, "canaries", file, workers, told)
    if profile is not None:
        unnamed = [each.mutant.name for each in judged(answers, names) if not each.by_name]
        if unnamed != [UNCHANGED.name]:
            # The unchanged night first: the others are held against it.
            ask([UNCHANGED.name], "night", file, 1, told, profile)
            answers = ask(unnamed, "night", file, workers, told, profile)
    return list(judged(answers, names))
