"""How much of an angle against a registered model is the registration's: python -m studies.registration [FIGURE].

Five views of a generated liver with 26 specularities in all, as the article has them. The model that the normals are
compared with is the liver itself, moved by a registration error: turned about its middle by an angle around a random
axis, and moved by a length in a random direction. Normals come from the rendered frames; beside them the true normals
are compared as well, which shows the registration alone.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtest.estimators import Estimate, load_estimators
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.seeds import Stage, generator
from simtest.simulation.frame import render_view
from simtest.spec import scene_from_dict
from simtest.spec.toml_files import toml_value
from simtest.surfaces.factory import make_mesh
from simtest.surfaces.recipe import load_anatomy
from simtest.validation.references import MeshReference, Model
from simtest.validation.scoring import match

VIEWS, SPECULARITIES = 5, 26
TRIED = 48
DRAWS = 40
TRANSLATIONS_MM = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0)
ROTATIONS_DEG = (0.0, 2.5, 5.0)
ARTICLE_DEG = (7.11, 4.86)
ESTIMATORS = ("circle_pose", "cone_axis", "curved")
TRUTH = "true normals"
RECIPE = {"relief_mm": 0.5, "relief_length_mm": 20.0}


@dataclass(frozen=True)
class Observation:
    """A specularity: its peak, px, candidate normals by name, and the view's camera and camera_from_model."""

    peak: np.ndarray
    normals: dict[str, np.ndarray]
    camera: Camera
    camera_from_model: np.ndarray
    view: int


def spots(recipe: Path) -> list[Observation]:
    """Return the specularities of the views that have the most, the brightest first, in equal parts."""
    estimators, session, views = load_estimators(ESTIMATORS), None, []
    for viewpoint in range(TRIED):
        scene = scene_from_dict(
            {
                "surface": {"type": "anatomy", "path": str(recipe), "viewpoint": viewpoint},
                "reflectance": {"type": "phong", "exponent": 300.0, "diffuse": 0.3},
                "camera": {"width": 640, "height": 480, "fx": 540.0, "fy": 540.0},
                "sensor": {"noise_sigma": 0.01},
            },
            "registration study",
        )
        session = session or Session(scene)
        seen = render_view(session, scene)
        found = reconstruct(seen.frame(viewpoint), seen.calibration, estimators)
        truths = [truth for truth in seen.highlights if truth.isolated]
        camera_from_model = np.linalg.inv(session.surface.model_from_camera)
        made = []
        for i, j in match(found, [truth.bp_px for truth in truths]).items():
            normals = {TRUTH: truths[j].normal[None]}
            for name, result in found[i].estimates.items():
                if isinstance(result, Estimate):
                    normals[name] = result.candidates
            if len(normals) == 1 + len(ESTIMATORS):
                made.append(Observation(truths[j].bp_px, normals, session.camera, camera_from_model, viewpoint))
        views.append(made)
    views.sort(key=len, reverse=True)
    taken: list[Observation] = []
    for rank in range(max(len(made) for made in views)):
        taken += [made[rank] for made in views[:VIEWS] if rank < len(made)]
    return taken[:SPECULARITIES]


def moved(spot: Observation, middle: np.ndarray, error: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return camera_from_model with a registration error of a length, mm, and an angle, deg."""
    import cv2

    length, angle = error
    axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn = cv2.Rodrigues(axis * np.radians(angle))[0]
    centre = spot.camera_from_model[:3, :3] @ middle + spot.camera_from_model[:3, 3]
    wrong = np.eye(4)
    wrong[:3, :3] = turn
    wrong[:3, 3] = centre - turn @ centre + length * direction
    return wrong @ spot.camera_from_model


def study(found: list[Observation], model: Model, error: tuple[float, float]) -> dict[str, np.ndarray]:
    """Return the angles by name, deg: each draw is one registration of each view; the better candidate counts."""
    angles: dict[str, list[float]] = {}
    middle = model.vertices.mean(axis=0)
    for draw in range(DRAWS if any(error) else 1):
        placed: dict[int, MeshReference] = {}
        for spot in found:
            if spot.view not in placed:
                rng = generator(0, "registration", f"{error}", draw * 1000 + spot.view, Stage.SWEEP)
                placed[spot.view] = MeshReference(model, moved(spot, middle, error, rng))
        for number, reference in placed.items():
            here = [spot for spot in found if spot.view == number]
            normals = reference.normals_at(np.array([spot.peak for spot in here]), here[0].camera)
            for spot, normal in zip(here, normals, strict=True):
                if np.isfinite(normal).all():
                    for name, candidates in spot.normals.items():
                        angles.setdefault(name, []).append(float(min(angle_deg(c, normal) for c in candidates)))
    return {name: np.array(values) for name, values in angles.items()}


def main(figure: Path | None) -> None:
    """Print the table; draw the figure."""
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "liver_study.toml"
        described = load_anatomy("liver", settings=RECIPE)
        tables = described.model_dump(exclude_none=True).items()
        recipe.write_text("".join(f"{key} = {toml_value(value)}\n" for key, value in tables), encoding="utf-8")
        found = spots(recipe)
    mesh, _, _ = make_mesh(described)
    model = Model(mesh.vertices, mesh.normals, mesh.faces)
    print(f"{len(found)} specularities in {len({spot.view for spot in found})} views")
    names = (TRUTH, *ESTIMATORS)
    print(f"| error of registration | {' | '.join(names)} |")
    results = {}
    for turn in ROTATIONS_DEG:
        for length in TRANSLATIONS_MM:
            angles = study(found, model, (length, turn))
            results[length, turn] = angles
            cells = [f"{angles[name].mean():.2f} ± {angles[name].std(ddof=1):.2f}" for name in names]
            print(f"| {length:g} mm, {turn:g} deg | {' | '.join(cells)} |")
    if figure is not None:
        draw(results, names, figure)


def draw(results: dict[tuple[float, float], dict[str, np.ndarray]], names: tuple[str, ...], path: Path) -> None:
    """Draw the mean angle over the length of the error, a panel for each angle of it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from simtest.pages.style import NEUTRAL, colours

    palette = {**colours(ESTIMATORS), TRUTH: "black"}
    figure, axes = plt.subplots(1, len(ROTATIONS_DEG), figsize=(11, 4.2), sharey=True, layout="constrained")
    for ax, turn in zip(axes, ROTATIONS_DEG, strict=True):
        published, spread = ARTICLE_DEG
        ax.axhspan(published - spread, published + spread, color=NEUTRAL, alpha=0.15)
        ax.axhline(published, color=NEUTRAL, ls="--", label=f"article: {published} ± {spread} deg")
        for i, name in enumerate(names):
            values = [results[length, turn][name] for length in TRANSLATIONS_MM]
            # A little apart, for what lies on top of each other.
            x = np.array(TRANSLATIONS_MM) + 0.12 * i
            mean, bars = [v.mean() for v in values], [v.std(ddof=1) for v in values]
            ax.errorbar(x, mean, bars, color=palette[name], marker="o", ms=4, lw=1.3, elinewidth=0.6, label=name)
        ax.set(xlabel="registration error: translation (mm)", title=f"and rotation {turn:g} deg", ylim=(0, None))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("angle against the registered model (deg)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
