"""Memory of a process and all that it has started, from Linux's /proc."""

import subprocess
import time
from pathlib import Path


def peak_of_tree_mib(process: subprocess.Popen[bytes], step_s: float = 0.1) -> float:
    """Watch a process until it ends; give the peak of the memory of its whole tree, shared pages once, MiB."""
    peak = 0.0
    while process.poll() is None:
        peak = max(peak, sum(_proportional_mib(pid) for pid in _tree(process.pid)))
        time.sleep(step_s)
    return peak


def _tree(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(descendant for child in children for descendant in _tree(int(child)))]


def _proportional_mib(pid: int) -> float:
    """Give a process's proportional set size, MiB: what it shares with n processes counts for 1/n."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:")), 0.0)
