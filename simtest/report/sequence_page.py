"""The page of a sequence: its frames one by one, and its tracks."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

LEAST_FRAMES = 3
"""Shorter tracks are counted, not listed."""


def write_sequence_page(path: Path, documents: Sequence[dict[str, Any]], tracks: Sequence[dict[str, Any]]) -> None:
    """Write the page; the pictures lie beside it in frames/."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    frames = [
        {"file": f"frames/{d['frame_index']:06d}.jpg", "name": d["image"], "time": d["time_s"],
         "count": len(d["specularities"])}
        for d in documents
    ]  # fmt: skip
    listed = [track for track in tracks if len(track["frames"]) >= LEAST_FRAMES]
    place = {document["frame_index"]: i for i, document in enumerate(documents)}
    text = json.dumps({"frames": frames, "place": place}, allow_nan=False)
    text = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    html = environment.get_template("sequence.html.j2").render(
        count=len(frames), tracks=listed, short=len(tracks) - len(listed), data=Markup(text)
    )
    path.write_text(html, encoding="utf-8")
