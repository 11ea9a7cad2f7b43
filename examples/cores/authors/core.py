"""The circle pose of a public script, as a core: the script's own functions run, from a clone of yours.

The scripts of the method's authors, https://github.com/k16makki/EndoMapper_UCA_Specularity, have no licence: nothing of
them is copied here. Clone them yourself, and name one of the scripts that define `Zisserman_method` and
`fit_ellipse_lstsq`:

    git clone https://github.com/k16makki/EndoMapper_UCA_Specularity
    simtest validate plane --estimator circle_pose --estimator \
        "command: python examples/cores/authors/core.py EndoMapper_UCA_Specularity/ICRA2024/ICRA2024_colonoscopy.py"

Only the named functions of the script are run, not its main part, which opens windows and reads files of its authors.
`--branch eigenvector` takes the branch that the scripts themselves call, with case="synthetic". The environment needs
NumPy alone.
"""

import argparse
import ast
import json
import math
import sys
from pathlib import Path

import numpy as np

ISOPHOTE = "isophote_0.5"
BRANCHES = {"pose": "non-synthetic", "eigenvector": "synthetic"}
POSE, FIT, CHOICE = "Zisserman_method", "fit_ellipse_lstsq", "normal_disambiguiting"
NEEDED = (POSE, FIT, CHOICE, "dual_conic", "sorted_eigen", "plane_normal")
LEAST_POINTS = 6


def load(script):
    """Return the needed functions of a script, which is parsed but not run."""
    tree = ast.parse(script.read_text(encoding="utf-8"), str(script))
    kept = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in NEEDED]
    if missing := sorted(set(NEEDED) - {node.name for node in kept}):
        sys.exit(
            f"{script}: defines no function {', '.join(missing)}; must be a script with all of {', '.join(NEEDED)}"
        )
    functions = {"np": np, "math": math, "sys": sys}
    exec(compile(ast.Module(kept, []), str(script), "exec"), functions)
    return functions


def estimate(request, arrays, theirs, branch):
    """Return the fields of an answer: fit, pose and choice are the script's, the signs of the normals ours."""
    if request["camera"]["distortion"] is not None:
        return failure("not_known", "the script knows K alone; the lens must not distort")
    if ISOPHOTE not in arrays:
        return failure("no_closed_isophote", "the isophote was not sent")
    points = arrays[ISOPHOTE][:-1]  # the polygon is closed; its first point counts once
    if len(points) < LEAST_POINTS:
        return failure("too_few_points", f"{len(points)} points; at least {LEAST_POINTS} are needed")
    K = np.array(request["camera"]["K"])
    direct = np.linalg.solve(K, [*points.mean(axis=0), 1.0])
    direct /= np.linalg.norm(direct)
    conic = theirs[FIT](points)
    with np.errstate(invalid="ignore"):
        pair = np.array([np.real(n) for n in theirs[POSE](conic, K, case=BRANCHES[branch])])
    if not np.isfinite(pair).all():
        return failure("not_an_ellipse", "the script's normals are not finite")
    chosen = np.real(theirs[CHOICE](*pair, direct))
    # Eigenvectors have either sign; those of a normal that faces the camera are wanted.
    candidates = [facing(chosen, direct)]
    candidates += [facing(n, direct) for n in pair if not np.array_equal(n, chosen)]
    return {
        "type": "estimate", "normal": candidates[0], "candidates": candidates, "look_ray": direct.tolist(),
        "flags": ["one_normal"] if np.array_equal(*pair) else [],
    }  # fmt: skip


def facing(normal, sightline):
    """Return a unit normal as a list, turned so that it faces the camera."""
    unit = normal / np.linalg.norm(normal)
    return (-unit if unit @ sightline > 0 else unit).tolist()


def failure(reason, detail):
    """Return an answer that there is no normal, and why."""
    return {"type": "failure", "reason": reason, "detail": detail}


def main():
    """Greet, then answer each request until standard input closes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("script", type=Path)
    parser.add_argument("--branch", choices=BRANCHES, default="pose")
    given = parser.parse_args()
    answers, sys.stdout = sys.stdout.buffer, sys.stderr  # the scripts print
    theirs = load(given.script)
    hello = {
        "type": "hello", "protocol": 1, "name": f"authors_{given.branch}", "version": given.script.stem,
        "kind": "patch", "arrays": [ISOPHOTE], "isophotes": [0.5],
    }  # fmt: skip
    for line in iter(sys.stdin.buffer.readline, b""):
        header = json.loads(line)
        if header["type"] == "hello":
            answer = hello
        else:
            arrays = {}
            for entry in header.get("arrays", []):
                dtype, shape = np.dtype(entry["dtype"]), entry["shape"]
                content = sys.stdin.buffer.read(dtype.itemsize * int(np.prod(shape)))
                arrays[entry["name"]] = np.frombuffer(content, dtype).reshape(shape)
            answer = {**estimate(header, arrays, theirs, given.branch), "id": header["id"]}
        answers.write(json.dumps(answer).encode() + b"\n")
        answers.flush()


if __name__ == "__main__":
    main()
