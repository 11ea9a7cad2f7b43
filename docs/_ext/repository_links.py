"""Links from a page to a file of the repository that is no page: the file is copied into the site.

In Markdown, as it is read in the repository, `[the unit](../../deploy/simtest-nightly.timer)` works as it stands. A
link to CHANGELOG.md goes to the page that is made of it; a folder is named, but not linked; a file that does not exist
stays a warning of MyST's.
"""

import os
import re
import shutil
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

FILES = "_files"
"""Folder of the site that holds the copies."""

CHANGES = "changes.md"
"""Page that is made of CHANGELOG.md."""

OUTER = re.compile(r"\]\(((?:\.\./)+)([\w./-]+\.md)((?:#[\w-]*)?)\)")
"""A link to Markdown in a folder above the page's."""


def rewrite(app: Sphinx, name: str, source: list[str]) -> None:
    """Point links to Markdown outside docs/, which MyST would look for among the pages, to a page or to the file."""
    docs = Path(app.srcdir)
    here = (docs / name).parent

    def target(match: re.Match[str]) -> str:
        up, path, anchor = match.groups()
        file = (here / up / path).resolve()
        if docs in file.parents or not file.exists():
            return match[0]
        if file == docs.parent / "CHANGELOG.md":
            return f"]({os.path.relpath(docs / CHANGES, here)}{anchor})"
        return f"](path:{up}{path})"

    source[0] = OUTER.sub(target, source[0])


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element) -> nodes.Element | None:
    """Return a link to a file outside docs/; None where there is no such file."""
    if node.get("reftype") != "myst":
        return None
    root, page = Path(app.srcdir).parent, node["refdoc"]
    file = (Path(env.doc2path(page)).parent / node["reftarget"].partition("#")[0]).resolve()
    if not file.exists() or root not in file.parents:
        return None
    if file.is_dir():
        return content
    name = file.relative_to(root).as_posix()
    copied = Path(app.outdir) / FILES / name
    copied.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, copied)
    uri = os.path.relpath(f"{FILES}/{name}", Path(page).parent)
    return nodes.reference("", "", content, refuri=uri, internal=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Rewrite links before MyST reads them, and resolve what it could not."""
    app.connect("source-read", rewrite)
    app.connect("missing-reference", resolve, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": False}
