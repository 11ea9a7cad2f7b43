"""Risky calls in our own code (bandit), and known vulnerabilities of the pinned packages (pip-audit).

Exit 1 where either finds something. Where one cannot run, or cannot look packages up, one line says so, and that is no
failure: both need packages or a network that a machine may not have. Exceptions stand, explained, in pyproject.toml.
"""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 600


def main() -> int:
    """Run both; return 1 where one finds something."""
    found = 0
    for name, arguments, read in (
        ("bandit", ["-q", "-r", "simtest", "-c", "pyproject.toml", "-f", "json"], risky_calls),
        ("pip-audit", ["-r", "constraints.txt", "--no-deps", "--disable-pip", "-f", "json"], vulnerabilities),
    ):
        report = _report(name, arguments)
        if isinstance(report, str):
            print(f"audit: {name} cannot be run here ({report}); left out")
            continue
        findings, note = read(report)
        print(*(f"audit: {name}: {finding}" for finding in findings), sep="\n", end="\n" * bool(findings))
        print(f"audit: {name}: {len(findings)} findings{note}")
        found += len(findings)
    return 1 if found else 0


def _report(name: str, arguments: Sequence[str]) -> Mapping[str, Any] | str:
    """Return a tool's report, or why there is none."""
    command = [sys.executable, "-m", name.replace("-", "_"), *arguments]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return type(error).__name__
    try:
        return dict(json.loads(done.stdout))
    except ValueError:
        return (done.stderr.strip().splitlines() or ["no report"])[-1][:160]


def risky_calls(report: Mapping[str, Any]) -> tuple[list[str], str]:
    """Return bandit's findings as lines, and a note."""
    lines = [
        f"{result['filename']}:{result['line_number']}: {result['test_id']} {result['issue_text']}"
        for result in report["results"]
    ]
    return lines, "".join(f"; {error['filename']} could not be read" for error in report.get("errors", ()))


def vulnerabilities(report: Mapping[str, Any]) -> tuple[list[str], str]:
    """Return pip-audit's findings as lines, and how many packages it could not look up: it calls those sound too."""
    packages = report["dependencies"]
    lines = [
        f"{package['name']} {package['version']}: {fault['id']}, mended in {', '.join(fault['fix_versions']) or 'none'}"
        for package in packages
        for fault in package.get("vulns", ())
    ]
    unknown = sum("skip_reason" in package for package in packages)
    return lines, f"; {unknown} of {len(packages)} packages could not be looked up" if unknown else ""


if __name__ == "__main__":
    sys.exit(main())
