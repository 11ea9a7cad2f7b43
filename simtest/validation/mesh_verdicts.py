"""What `simtest mesh check` says of the mesh files that an experiment runs on."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from simtest.runtime.files import JsonObject
from simtest.runtime.resources import find
from simtest.spec import AnatomySurface, Experiment, Group, Scene, read_toml, scene_from_dict
from simtest.spec.toml_files import apply_settings
from simtest.spec.type_change import replace_values

DISTANCE_MM = 30.0
"""Of camera and light, as `simtest mesh check` takes it: the viewpoints are chosen later."""


@dataclass(frozen=True)
class MeshVerdict:
    """Whether a mesh file is fit for an experiment."""

    file: str
    usable: bool
    """Whether highlights on it mean something; a refinement by ``surface.edge_mm`` counts, subdivisions do not."""

    text: str
    """The verdict and what is wrong, in words."""

    def to_json(self) -> JsonObject:
        """Return the verdict for a script."""
        return {"file": self.file, "usable": self.usable, "verdict": self.text}

    def __str__(self) -> str:
        return f"mesh {self.file}: {self.text}"


def mesh_verdicts(experiment: Experiment) -> list[MeshVerdict]:
    """Judge each mesh file of an experiment once; recipes are fine by construction.

    Raises
    ------
    InputError
        If a scene is malformed, or a mesh cannot be used.
    """
    verdicts: dict[tuple[object, ...], MeshVerdict] = {}
    for scene in (scene for group in experiment.groups for scene in _scenes(group)):
        surface = scene.surface
        assert isinstance(surface, AnatomySurface)
        curvature = getattr(scene.reflectance, "lobe_curvature", None)
        key = (surface.file(), surface.kind, surface.edge_mm, curvature)
        if key not in verdicts:
            verdicts[key] = _judge(surface, curvature)
    return list(verdicts.values())


def _scenes(group: Group) -> Iterator[Scene]:
    """Yield a scene for each mesh file of a group; nothing is built."""
    path = find(group.scene, "scenes")
    base = replace_values(Scene, read_toml(path), group.set, str(path))
    swept = [values for table in (*group.sweep, *group.pool) for key, values in table.items() if key == "surface.path"]
    own: list[Any] = [base.get("surface", {}).get("path")]
    for name in dict.fromkeys(own if not swept else (value for values in swept for value in values)):
        if isinstance(name, str) and Path(name).suffix.lower() not in ("", ".toml"):
            scene = scene_from_dict(apply_settings(base, {"surface.path": name}, str(path)), str(path))
            if isinstance(scene.surface, AnatomySurface):
                yield scene


@lru_cache(maxsize=8)
def _judge(surface: AnatomySurface, curvature: float | None) -> MeshVerdict:
    # Loaded where there is a mesh: most experiments have none.
    from simtest.surfaces.fineness import concentration
    from simtest.surfaces.mesh_check import check_mesh

    lobe = concentration(None, None) if curvature is None else curvature
    found = check_mesh(surface.file(), DISTANCE_MM, lobe, surface.kind)
    refined = False
    if found.fine:
        text = "fine enough"
    elif found.needed_edge_mm is None:
        text = "too large to be judged"
    else:
        text = f"too coarse: edges of {found.needed_edge_mm:.2g} mm are needed (surface.edge_mm)"
        refined = surface.edge_mm == "auto" or (surface.edge_mm or float("inf")) <= found.needed_edge_mm
        if refined:
            text = f"refined to what it needs by surface.edge_mm = {surface.edge_mm}"
    text += "".join(f"; {problem}" for problem in found.problems)
    return MeshVerdict(str(surface.path), (found.fine or refined) and not found.problems, text)
