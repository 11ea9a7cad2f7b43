"""Print the table of docs/measured/anatomy.md: found, false detections and errors.

python -m studies.anatomy_table colon 1000 1400 FOLDER

runs the direct-light group of an experiment (or a mesh's file through the experiment `mesh`) over the viewpoints 1000
to 1399 and keeps the run in FOLDER.
"""

import sys
from pathlib import Path

import polars as pl

from simtest.spec import load_experiment
from simtest.validation.runner import run_experiment


def main() -> None:
    """Run, and print a row for each estimator."""
    surface, first, last, folder = sys.argv[1:]
    shipped = surface in ("colon", "liver")
    experiment = load_experiment(surface if shipped else "mesh", None if shipped else {"surface.path": surface})
    pool = ({"surface.viewpoint": tuple(range(int(first), int(last)))},)
    groups = (experiment.groups[0].model_copy(update={"pool": pool}),)
    results = run_experiment(experiment.model_copy(update={"groups": groups}), Path(folder)).results
    for (name,), rows in results.group_by("estimator", maintain_order=True):
        true = rows.filter(pl.col("true_id").is_not_null())
        found, false = true.filter(pl.col("status") != "missed"), rows.height - true.height
        ok = found.filter(pl.col("status") == "ok")
        shares = f"{found.height / true.height:.1%} | {false / (found.height + false):.1%}"
        medians = " | ".join(f"{ok[c].median():.3f}" for c in ("error_oracle_deg", "error_deg", "error_look_deg"))
        print(f"| {Path(surface).stem} | {name} | {true.height} | {ok.height} | {shares} | {medians} |")


if __name__ == "__main__":
    main()
