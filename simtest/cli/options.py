"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

Settings = Annotated[
    list[str] | None,
    Parameter(
        name="--set", negative="", help="Replace a value: key=value, such as surface.radius_mm=5; may be repeated."
    ),
]
Variant = Annotated[
    str | None, Parameter(help="Mitsuba variant, such as cuda_ad_mono; default SIMTEST_VARIANT, else llvm_ad_mono.")
]
Estimators = Annotated[
    list[str] | None, Parameter(name="--estimator", negative="", help="Estimator by name; may be repeated.")
]
Out = Annotated[Path, Parameter(help="Folder for the results; made if need be.")]
