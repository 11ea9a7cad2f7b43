"""The gate's error rates, measured: false alarms, a rise of one estimator's error, and planted faults.

`python -m benchmarks gate` makes a bank of 20,400 realisations (10 minutes of processor time; kept in the folder that
GATE_BANK names, default gate-bank in the system's folder for temporary files), draws nights from it, plants the faults,
and prints every figure beside its limit. `python -m benchmarks.gate` prints the tables of docs/gate.md instead.
"""

from benchmarks.measuring import Figure


def figures() -> list[Figure]:
    """Give all figures beside their limits."""
    # Here: processes that judge nights need nothing of the renderer.
    from benchmarks.gate.proof import figures as proved

    return proved()
