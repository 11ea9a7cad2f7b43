"""All mutants, in the order of the table."""

from studies.mutants.camera_and_sensor import CAMERA, SENSOR
from studies.mutants.further import FURTHER
from studies.mutants.mutant import Mutant
from studies.mutants.results import COVARIANCE, DATASET, ROWS, SEEDS, STATISTICS
from studies.mutants.scene import LIGHT, TISSUE, TRUTH

UNCHANGED = Mutant("unchanged", "control", ())
"""The code as it is: nobody may raise an alarm."""

MUTANTS = (
    *CAMERA, *SENSOR, *LIGHT, *TISSUE, *TRUTH, *SEEDS, *STATISTICS, *ROWS, *COVARIANCE, *DATASET,
)  # fmt: skip

BY_NAME = {mutant.name: mutant for mutant in (UNCHANGED, *MUTANTS, *FURTHER)}
