"""Results of a small experiment against stored numbers: a change that moves them has to say so.

`python tests/regression/test_reference.py` writes the reference anew.
"""

import json
import tempfile
from pathlib import Path

import pytest

from simtest.spec import load_experiment
from simtest.validation.runner import run_experiment

HERE = Path(__file__).resolve().parent
EXPERIMENT = HERE / "reference" / "small.toml"
REFERENCE = HERE / "reference" / "small.json"

# Another processor's code width and BLAS move single results by rounding, medians by less than this.
TOLERANCE_DEG = 1e-3


def measure(folder):
    results = run_experiment(load_experiment(EXPERIMENT), folder).results
    columns = ["setting", "realisation", "estimator", "status", "error_deg", "axis_ratio", "bp_true_x_px", "kd_max"]
    return results.select(columns).to_dicts()


@pytest.mark.render
def test_results_equal_the_reference(tmp_path):
    rows, reference = measure(tmp_path / "run"), json.loads(REFERENCE.read_text())
    assert len(rows) == len(reference)
    for row, expected in zip(rows, reference, strict=True):
        for name, value in expected.items():
            if isinstance(value, float):
                assert row[name] == pytest.approx(value, abs=TOLERANCE_DEG), (expected, name)
            else:
                assert row[name] == value, (expected, name)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        REFERENCE.write_text(json.dumps(measure(Path(folder) / "run"), indent=1) + "\n")
