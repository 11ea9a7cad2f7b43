"""Checks the backend by rendering a small scene in a child process."""

import json
import subprocess
import sys
from dataclasses import replace

from simtest.rendering import backend

RENDER_TIMEOUT_S = 180


def examine(variant: str | None = None) -> backend.BackendReport:
    """Examine the rendering backend (see `simtest.rendering.backend.requested_variant`); this process loads nothing."""
    report = backend.library_report(variant)
    return replace(report, problem=_try_rendering(report.variant)) if report.can_render else report


def _try_rendering(variant: str) -> str | None:
    """Render a plane in a child process; return the problem, or None."""
    # A child: a bad libLLVM may end the process.
    # -P: no file of the current folder may stand in for a package.
    command = [sys.executable, "-P", "-m", "simtest.rendering.backend_check", variant]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"rendering a small scene took more than {RENDER_TIMEOUT_S} s"
    if child.returncode == 0:
        return None
    if child.returncode < 0:
        return f"rendering a small scene ended the process (signal {-child.returncode}). To mend it: {backend.MENDING}"
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
