"""`simtest schema`."""

import json
from typing import Literal


def schema(of: Literal["scene", "experiment", "camera"] = "scene", /) -> None:
    """Print the JSON schema of a file.

    Parameters
    ----------
    of : str
        What to describe.
    """
    from simtest.spec import CameraSpec, Experiment, Scene

    model = {"scene": Scene, "experiment": Experiment, "camera": CameraSpec}[of]
    print(json.dumps(model.model_json_schema(), indent=2))
