"""The gate's error rates, measured: false alarms, a rise of one estimator's error, and planted faults.

`python -m studies.gate` prints the tables of docs/gallery/gate_measured.md; `python -m studies.gate figures` prints
the same figures beside their limits. The bank of 20,400 realisations takes 10 minutes of processor time and is kept in
the folder that GATE_BANK names (default: gate-bank in the system's folder for temporary files).
"""

from benchmarks.measuring import Figure


def figures() -> list[Figure]:
    """Return all figures beside their limits."""
    # Imported here: processes that judge runs need nothing of the renderer.
    from studies.gate.proof import figures as proved

    return proved()
