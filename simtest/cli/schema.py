"""`simtest schema`."""

import json
from typing import Literal


def schema(of: Literal["scene", "experiment", "dataset", "camera", "calibration", "profile"] = "scene", /) -> None:
    """Print the JSON schema of a file.

    Parameters
    ----------
    of : str
        What to describe.
    """
    from pydantic import BaseModel

    from simtest.spec import CalibrationSpec, CameraSpec, Dataset, Experiment, Profile, Scene

    models: dict[str, type[BaseModel]] = {
        "scene": Scene,
        "experiment": Experiment,
        "dataset": Dataset,
        "camera": CameraSpec,
        "calibration": CalibrationSpec,
        "profile": Profile,
    }
    print(json.dumps(models[of].model_json_schema(), indent=2))
