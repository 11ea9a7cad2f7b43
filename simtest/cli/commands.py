"""The application and its sub-commands, which are imported when they are called: `simtest --help` answers at once."""

from typing import Annotated, Literal

from cyclopts import App, Parameter

APP = App(
    name="simtest",
    help="Simulation testbed for 3D reconstruction from specular highlights in endoscopy.",
    # Plain, since the modules that lay out Markdown take longer to load than all the rest.
    help_format="plaintext",
    help_epilogue="Every command takes --quiet, -q (neither progress nor warnings nor notes), --verbose, -v (every "
    "step, every row, debug messages) and --traceback.",
    version_flags=["--version"],
    version=lambda: _version(),
    # `main` reports what is kept.
    suppress_keyboard_interrupt=False,
)
# Stated here, since a sub-command's own text is loaded with its module.
COMMANDS = {
    "doctor": "Check the rendering backend.",
    "list": "List what is shipped and installed: scenes, experiments, datasets, estimators, presets.",
    "schema": "Print the JSON schema of a scene, experiment, dataset, camera, calibration or profile file.",
    "render": "Render a scene with its ground truth.",
    "views": "Pick viewpoints of an anatomy that show isolated highlights.",
    "view": "Show a scene in 3D: curvature, camera, lights, true and estimated normals.",
    "export": "Write a scene as files that Mitsuba itself loads.",
    "reconstruct": "Reconstruct the normals at the specularities of a picture, a folder or a video.",
    "calibrate": "Measure where the lights are, or how far off a core's normals are.",
    "advise": "Measure what a scope and its lights can reach: method, expected error, break-points.",
    "twin": "Render twins of a picture's highlights, and measure the error at each.",
    "realism": "Measure how far generated frames are from real ones.",
    "fit": "Fit the ranges of a dataset recipe to real frames.",
    "core": "Check a reconstruction core that runs as a command of its own.",
    "validate": "Run an experiment and write its report.",
    "score": "Score normals that were estimated elsewhere on exported frames.",
    "nightly": "Run the fixed experiments, compare with the baseline, write the page.",
    "bench": "Run the frozen benchmark, make a table of its certificates.",
    "dataset": "Make a labelled dataset for learning, check it, look at it.",
    "camera": "Show what a camera file means, or convert it to another program's format.",
    "mesh": "Check a mesh of yours, or make a colon or liver from its recipe.",
    "completion": "Print or install the completion of commands, options and names for a shell.",
}
GONE = {"train": "train in PyTorch on simtest.dataset.learn.Samples (examples/11_train_a_network.py)"}
"""Commands that are gone, and what takes their place."""

_HOMES = {
    "scenes": ("doctor", "export", "list", "mesh", "render", "schema", "view", "views"),
    "pictures": ("calibrate", "camera", "reconstruct", "twin"),
    "runs": ("bench", "core", "nightly", "score", "validate"),
    "data": ("advise", "dataset", "fit", "realism"),
    "commands": ("completion",),
}
"""Modules of the commands. The function of `list` is `listing`, since it would hide Python's own."""

for _name, _help in COMMANDS.items():
    _module = next(module for module, names in _HOMES.items() if _name in names)
    APP.command(f"simtest.cli.{_module}:{'listing' if _name == 'list' else _name}", name=_name, help=_help)


def _version() -> str:
    from simtest.runtime.provenance import version

    return version()


def completion(
    shell: Literal["bash", "zsh", "fish"],
    /,
    *,
    install: Annotated[
        bool, Parameter(negative="", help="Write it where the shell finds it, instead of printing it.")
    ] = False,
) -> None:
    """Print the script that completes commands, options and shipped names, or install it for your shell.

    Without --install: `simtest completion bash > FILE`, and a line `source FILE` in ~/.bashrc.

    Parameters
    ----------
    shell : str
        Whose script.
    """
    if install:
        print(APP.install_completion(shell=shell))
    else:
        print(APP.generate_completion(prog_name="simtest", shell=shell))
