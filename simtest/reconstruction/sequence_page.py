"""The page of a sequence: its frames one by one, and its tracks."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from simtest.pages.html import environment, script_json

LEAST_FRAMES = 3
"""Shorter tracks are counted, not listed."""


def write_sequence_page(path: Path, documents: Sequence[dict[str, Any]], tracks: Sequence[dict[str, Any]]) -> None:
    """Write the page; the pictures lie beside it in frames/."""
    from markupsafe import Markup

    frames = [
        {"file": f"frames/{d['frame_index']:06d}.jpg", "name": d["image"], "time": d["time_s"],
         "count": len(d["specularities"])}
        for d in documents
    ]  # fmt: skip
    listed = [track for track in tracks if len(track["frames"]) >= LEAST_FRAMES]
    place = {document["frame_index"]: i for i, document in enumerate(documents)}
    template = environment().get_template("sequence.html.j2")
    html = template.render(
        count=len(frames),
        tracks=listed,
        short=len(tracks) - len(listed),
        data=Markup(script_json({"frames": frames, "place": place})),
    )
    path.write_text(html, encoding="utf-8")
