"""What `simtest mesh check` says of the mesh files that an experiment runs on."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict

from simtest.runtime.resources import find
from simtest.spec import AnatomySurface, Experiment, Group, Scene, read_toml, scene_from_dict
from simtest.spec.keys import replace_values
from simtest.spec.toml_files import apply_settings

if TYPE_CHECKING:
    from simtest.surfaces.mesh_check import MeshCheck


class MeshVerdict(BaseModel):
    """Whether a mesh file is fit for an experiment."""

    model_config = ConfigDict(frozen=True)

    file: str
    usable: bool
    """Whether highlights on it mean something; a refinement by ``surface.edge_mm`` counts, subdivisions do not."""

    verdict: str
    """The verdict and what is wrong, in words."""

    def __str__(self) -> str:
        return f"mesh {self.file}: {self.verdict}"


def mesh_verdicts(experiment: Experiment) -> list[MeshVerdict]:
    """Judge each mesh file of an experiment once (`verdicts_of`)."""
    return verdicts_of(scene for group in experiment.groups for scene in _scenes(group))


def verdicts_of(scenes: Iterable[Scene]) -> list[MeshVerdict]:
    """Judge each mesh file of scenes once; recipes are fine by construction.

    A file has several verdicts only where scenes of other lobes or refinements are judged otherwise.
    """
    verdicts: dict[tuple[object, ...], MeshVerdict] = {}
    for scene in scenes:
        surface = scene.surface
        if not isinstance(surface, AnatomySurface) or surface.file().suffix.lower() == ".toml":
            continue
        # A lobe without a closed form counts as the Gaussian that is as wide at half its height.
        lobe = scene.reflectance.lobe_curvature or 2 * math.log(2) / scene.reflectance.half_width**2
        key = (surface.file(), surface.kind, surface.edge_mm, lobe)
        if key not in verdicts:
            verdicts[key] = _judge(surface, lobe)
    return list(dict.fromkeys(verdicts.values()))


def _scenes(group: Group) -> Iterator[Scene]:
    """Yield a scene for each mesh file of a group; nothing is built."""
    path = find(group.scene, "scenes")
    base = replace_values(Scene, read_toml(path), group.set, str(path))
    swept = [values for table in (*group.sweep, *group.pool) for key, values in table.items() if key == "surface.path"]
    surface = base.get("surface")
    own: list[Any] = [surface.get("path")] if isinstance(surface, dict) else []
    for name in dict.fromkeys(own if not swept else (value for values in swept for value in values)):
        if isinstance(name, str) and Path(name).suffix.lower() not in ("", ".toml"):
            yield scene_from_dict(apply_settings(base, {"surface.path": name}, str(path)), str(path))


def _judge(surface: AnatomySurface, lobe: float) -> MeshVerdict:
    # Loaded where there is a mesh: most experiments have none.
    from simtest.surfaces.mesh_check import check_mesh

    found = check_mesh(surface.file(), None, lobe, surface.kind)
    # At the distance of the nearest viewpoints, which see the narrowest highlights.
    needed, fine, at = found.needed_edge_mm, found.fine, f" at {found.distance_mm:g} mm"
    if fine:
        text = "fine enough"
    elif needed is None:
        text = "too large to be judged"
    elif surface.edge_mm is None:
        text = f"too coarse: edges of {needed:.2g} mm are needed{at} (surface.edge_mm)"
    else:
        reached = _refined_edge(found, needed if surface.edge_mm == "auto" else surface.edge_mm)
        fine = reached <= needed
        text = f"refined to edges of {reached:.2g} mm by surface.edge_mm = {surface.edge_mm}"
        text += f", at most {needed:.2g} mm are needed{at}" if fine else f": too coarse, {needed:.2g} mm are needed{at}"
    text += f"; taken for {found.side}"
    # A lumen that is judged from outside yields plausible figures of the wrong surface.
    doubt = f"; {found.doubt} (surface.kind=lumen)" if found.doubt else ""
    text += doubt + "".join(f"; {problem}" for problem in found.problems)
    return MeshVerdict(file=str(surface.path), usable=fine and not found.problems and not doubt, verdict=text)


def _refined_edge(found: "MeshCheck", target_mm: float) -> float:
    """Return the length, mm, that 95 % of the edges do not exceed once the mesh is refined as far as it may be."""
    from simtest.surfaces.mesh_surface import halvings, subdivisions_within_limit

    wanted = halvings(found.edge_p95_mm, target_mm)
    return float(found.edge_p95_mm / 2 ** subdivisions_within_limit(found.faces, wanted))
