"""Runs the tests that could see a fault, first on sound code, then with the fault planted, each in a fresh process."""

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from studies.mutants.plugin import CAUGHT
from studies.mutants.rows import Row

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_name("caught.json")
"""Who caught each fault, by section and name."""

LIMIT_S = 600
"""A fault may let a test hang, which is seen as well."""

NOBODY, NOT_RUN, HANGS = "nobody", "cannot be run", "no end"

PASSED, FAILED = 0, 1
"""Exit codes of pytest."""


class GuardError(Exception):
    """Tests that fail on sound code."""


def is_caught(who: str | None) -> bool:
    """Return whether somebody caught a fault."""
    return who is not None and who != NOBODY and not who.startswith(NOT_RUN)


def pytest_run(tests: Iterable[str], *options: str) -> tuple[int, str]:
    """Run tests as `make test` does, in a fresh process; return pytest's exit code and what it printed."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "studies.mutants.plugin", "-p", "no:cacheprovider",
               "-m", "not slow", *options, *tests]  # fmt: skip
    # What is kept for later processes must not hold the fault, nor hide it.
    environment = {**os.environ, "SIMTEST_CACHE": "off", "SIMTEST_EXAMPLES": "few", "PYTHONPATH": str(ROOT)}
    environment.setdefault("SIMTEST_THREADS", "1")
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        return FAILED, f"{CAUGHT}{HANGS}"
    return done.returncode, done.stdout + done.stderr


def check_sound(test: str) -> None:
    """Raise `GuardError` if a test file fails without a fault, or holds no test."""
    code, output = pytest_run([test])
    if code != PASSED:
        raise GuardError(f"{test}: without a fault the tests must pass:\n{output[-2000:]}")


def catcher(row: Row) -> str:
    """Return the first test that fails under a fault; `NOBODY` where all pass, `NOT_RUN` with why where none ran."""
    code, output = pytest_run(row.tests, "--plant", row.name)
    if code == PASSED:
        return NOBODY
    caught = [line.removeprefix(CAUGHT) for line in output.splitlines() if line.startswith(CAUGHT)]
    if caught:
        return caught[0]
    # An abort or a segmentation fault under the fault is seen as well; a fault that cannot be planted is not.
    return f"signal {-code}" if code < 0 else f"{NOT_RUN}: exit {code}, {(output.strip().splitlines() or [''])[-1]}"


def judge(rows: Iterable[Row], workers: int) -> Iterator[tuple[Row, str]]:
    """Yield who catches each fault, once the tests have passed without one."""
    rows = list(rows)
    for row in rows:
        row.mutations()
    with ThreadPoolExecutor(workers) as threads:
        # Each file once: rows share them.
        for _ in threads.map(check_sound, sorted({test for row in rows for test in row.tests})):
            pass
        yield from zip(rows, threads.map(catcher, rows), strict=True)


def read_table(path: Path = TABLE) -> dict[str, str]:
    """Return who caught each fault when it was last asked, by its name."""
    sections = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {name: who for section in sections.values() for name, who in section.items()}


def write_table(rows: Iterable[Row], caught: dict[str, str], path: Path = TABLE) -> None:
    """Write who caught each fault, in the order of the rows; what is no row any more is left out."""
    sections: dict[str, dict[str, str]] = {}
    for row in rows:
        if row.name in caught:
            sections.setdefault(row.room, {})[row.name] = caught[row.name]
    path.write_text(json.dumps(sections, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
