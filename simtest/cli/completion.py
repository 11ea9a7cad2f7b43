"""`simtest completion`."""

from typing import Literal

from cyclopts import Parameter

from simtest.cli.options import Annotated


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
    from simtest.cli.commands import APP

    if install:
        print(APP.install_completion(shell=shell))
    else:
        print(APP.generate_completion(prog_name="simtest", shell=shell))
