"""The page of commands, from the commands' own help, and the page of the names that they take."""

import inspect
import re
import sys
from unittest.mock import patch

from cyclopts import App

from simtest.cli.commands import APP
from simtest.cli.scenes import HEADINGS, names_of
from studies.manual.markdown import code, table

OPENING = """# Commands

This page is made from the commands' own help; `simtest COMMAND --help` prints the same. Every command also takes
`--quiet` (neither progress nor warnings), `--verbose` (every step, every row) and `--traceback` (where an error came
up).

Exit codes: 0 done; 1 could not render, a full disk, or a command's own verdict; 2 bad input; 130 Ctrl-C; 143 SIGTERM.
For `nightly`, 1 is a regression or an unexplained change, and whatever else went wrong is 2.

[What is shipped](shipped.md) lists the names that commands take: scenes, experiments, datasets, profiles,
estimators, detectors and presets.

```{toctree}
:hidden:

shipped
```

"""


def command(path: list[str]) -> App:
    """Return a command by its names, such as ["dataset", "verify"]."""
    app = APP
    for name in path:
        app = app[name]
    return app


def commands() -> list[list[str]]:
    """Return the names of all commands, those below others too, in the order of the help."""

    def below(path: list[str]) -> list[list[str]]:
        # Iterating over an App names its flags (--help) too.
        names = [name for name in command(path) if not name.startswith("-")]
        return [found for name in names for found in ([*path, name], *below([*path, name]))]

    return below([])


def _further(path: list[str]) -> str:
    """Return what a command's docstring says beyond its first paragraph and its parameters."""
    function = command(path).default_command
    text = inspect.getdoc(function) if function else None
    prose = re.split(r"\n\w[\w ]+\n-{3,}\n", f"{text or ''}\n")[0]
    return prose.partition("\n\n")[2].strip()


def commands_page() -> str:
    """Return the page as Markdown."""
    # The usage of commands below others quotes the process's own arguments.
    with patch.object(sys, "argv", ["simtest"]):
        made = APP.generate_docs(output_format="markdown", include_hidden=False)
    # What stands before the first command is the program's own help: a list of the commands, which the site has.
    sections = re.split(r"^(?=#{2,} simtest )", made, flags=re.MULTILINE)[1:]
    return OPENING + "".join(_section(text) for text in sections)


def _section(text: str) -> str:
    title, _, body = text.partition("\n")
    further = _further(title.split()[2:])
    usage, fence, rest = body.rpartition("```\n")
    head, _, options = rest.partition("\n**")
    if not further or not options or further in body:
        return text
    return f"{title}\n{usage}{fence}{head.rstrip()}\n\n{further}\n\n**{options}"


SHIPPED = """# What is shipped

The names that commands take, with a line about each; `simtest list` prints the same.

"""


def shipped_page() -> str:
    """Return the page of names as Markdown."""
    text = SHIPPED
    for kind, use in HEADINGS.items():
        rows = ((code(name), about) for name, about in names_of(kind).items())
        text += f"## {kind.capitalize()}\n\nUsed {use}.\n\n{table(('name', 'about'), rows)}\n\n"
    return text
