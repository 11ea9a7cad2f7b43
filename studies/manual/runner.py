"""Run the manual's blocks as a reader would: page by page, in order, in a copy of the checkout.

Where a page shows a block's output, what is printed must be as shown (`studies.manual.outputs`).
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

from studies.manual.blocks import ROOT, Block, blocks_of, manual_pages
from studies.manual.outputs import Shown, difference, with_outputs

SLOW = ("simtest nightly", "simtest validate", "simtest fit", "simtest realism", "simtest dataset endoscopy",
        "simtest dataset smooth", "-m studies.", "-m benchmarks")  # fmt: skip
"""What takes minutes, as it stands in a command: left out of a quick run."""

NEVER = ("make ", "pip install", "docker ", "apptainer ", "crontab", "systemctl", "git clone", "-m venv", "activate")
"""What installs something, or changes the machine: run by CI's own steps, or by nobody."""

WIDTH = "200"
"""Columns of the terminal, so that no table is squeezed."""

NAMESPACE = """
import json, sys, traceback
names = {"__name__": "__main__"}
for line in sys.stdin:
    try:
        exec(compile(json.loads(line), "<block>", "exec"), names)
        done = True
    except BaseException:
        traceback.print_exc(file=sys.stdout)
        done = False
    print(f"\\n{json.dumps({'done': done})}", flush=True)
"""
"""A Python that runs the blocks of a page one after another, so that names live on."""


def run_pages(pages: list[Path] | None, quick: bool, timeout_s: float, log: Path | None) -> int:
    """Run all blocks of the pages; print a line for each, and return 1 if one failed or printed something else."""
    failed = 0
    with ExitStack() as stack:
        output = stack.enter_context(log.open("w", encoding="utf-8")) if log else None
        for page in pages or manual_pages():
            blocks = list(with_outputs(list(blocks_of(page))))
            if blocks:
                scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="manual-")))
                failed += _run_page(blocks, scratch, quick, timeout_s, output)
    print(f"{failed} failed" if failed else "all ran")
    return 1 if failed else 0


def _run_page(
    blocks: list[tuple[Block, Shown | None]], scratch: Path, quick: bool, timeout_s: float, log: TextIO | None
) -> int:
    """Run the blocks of a page in a copy of the checkout; return how many failed or printed something else."""
    copy_checkout(scratch)
    failed = 0
    unmade: list[str] = []
    with _Python(scratch) as python:
        for block, shown in blocks:
            printed = ""
            complete = True
            for command in _pieces(block):
                # What needs a result that was left out is left out too.
                if any(word in command for word in NEVER + (SLOW if quick else ())) or reads(command, unmade):
                    unmade += outputs_of(command)
                    complete = False
                    _tell(f"{'left out':>8}         {block.place}: {_first(command)}", log)
                    continue
                started = time.monotonic()
                run = python.run if block.language == "python" else shell
                succeeded, text = run(command, scratch, timeout_s)
                # Of a session it counts what is printed.
                ok = succeeded or block.is_session
                spent = time.monotonic() - started
                failed += not ok
                complete = complete and ok
                printed += text
                _tell(f"{'ok' if ok else 'FAILED':>8} {spent:6.1f} s {block.place}: {_first(command)}", log)
                if log:
                    log.write(f"{command}\n{text}\n")
                elif not ok:
                    print(text[-2000:])
            if shown and complete:
                failed += not _is_as_shown(shown, printed, log)
    return failed


def _is_as_shown(shown: Shown, printed: str, log: TextIO | None) -> bool:
    """Return whether a block printed what the page shows; tell how not."""
    found = difference(shown, printed)
    _tell(f"{'ok' if found is None else 'FAILED':>8}          {shown.block.place}: output as shown", log)
    if found is not None:
        _tell(found, log)
    return found is None


def _pieces(block: Block) -> Iterator[str]:
    """Yield what is run at once: a Python block, or a line of a shell block."""
    if block.language == "python":
        yield block.code
    else:
        yield from block.lines


def outputs_of(command: str) -> list[str]:
    """Return the folders and files that a command of simtest writes to, as they stand in it or by default."""
    named = re.findall(r"--(?:out|reports|export)[ =](\S+)", command)
    elsewhere = re.search(r"--out[ =]", command)
    runs = [f"reports/runs/{name}" for name in re.findall(r"simtest validate (\w+)", command) if not elsewhere]
    return [*named, *runs, *(["reports/nightly"] if "simtest nightly" in command and not named else [])]


def reads(command: str, paths: list[str]) -> bool:
    """Return whether a command or block names one of these paths, or what lies below it."""
    return any(re.search(rf"(?<![\w./-]){re.escape(path)}(?![\w-])", command) for path in paths)


def copy_checkout(scratch: Path) -> None:
    """Copy the files that are in git, or would be."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in listed.split("\0"):
        if name and (ROOT / name).is_file():
            (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, scratch / name)


def _environment(scratch: Path) -> dict[str, str]:
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    return {**os.environ, "PATH": programs, "PYTHONPATH": str(scratch), "COLUMNS": WIDTH}


def shell(command: str, scratch: Path, timeout_s: float) -> tuple[bool, str]:
    """Run a line in a shell; return whether it succeeded, and what it printed."""
    child = subprocess.Popen(
        ["/bin/bash", "-c", command], cwd=scratch, env=_environment(scratch), stdin=subprocess.DEVNULL, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    try:
        text, _ = child.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGTERM)
        return False, f"{child.communicate()[0]}\nstopped after {timeout_s:g} s"
    return child.returncode == 0, text


class _Python:
    """A Python process for the blocks of one page, started with the first of them."""

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch
        self._child: subprocess.Popen[str] | None = None

    def __enter__(self) -> "_Python":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        """End the process, if there is one; its input's end is what it ends by."""
        if self._child is not None:
            self._child.communicate()

    def run(self, code: str, scratch: Path, timeout_s: float) -> tuple[bool, str]:
        """Run a block among the names of those before it."""
        if ">>> " in code:
            code = "\n".join(line[4:] for line in code.splitlines() if line.startswith((">>> ", "... ")))
        if self._child is None or self._child.poll() is not None:
            self._end()
            self._child = subprocess.Popen(
                [sys.executable, "-c", NAMESPACE], cwd=scratch, env=_environment(scratch), text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )  # fmt: skip
        assert self._child.stdin
        assert self._child.stdout
        self._child.stdin.write(f"{json.dumps(code)}\n")
        self._child.stdin.flush()
        text = ""
        watch = threading.Timer(timeout_s, self._child.kill)
        watch.start()
        try:
            for line in self._child.stdout:
                if line.startswith('{"done": '):
                    return bool(json.loads(line)["done"]), text
                text += line
        finally:
            watch.cancel()
        return False, f"{text}\nended, or stopped after {timeout_s:g} s"


def _first(command: str) -> str:
    lines = [line for line in command.splitlines() if line.strip()]
    return lines[0] + (" ..." if len(lines) > 1 else "")


def _tell(line: str, log: TextIO | None) -> None:
    print(line, flush=True)
    if log:
        log.write(f"{line}\n")
        log.flush()
