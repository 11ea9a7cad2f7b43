"""The pieces of work whose growth is measured, each at several sizes."""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.transfers import smooth_scene
from simtest.calibration import Calibration, srgb_encode
from simtest.geometry import Camera
from simtest.reconstruction import detect_in_picture, reconstruct
from simtest.reconstruction.options import default_estimators
from simtest.rendering import Session, backend
from simtest.report import write_report
from simtest.runtime.arrays import Image
from simtest.runtime.resources import find
from simtest.runtime.seeds import from_integer
from simtest.simulation.frame import render_picture
from simtest.spec import Scene, load_experiment
from simtest.spec.sensor import Sensor
from simtest.surfaces import forget_meshes
from simtest.surfaces.factory import make_mesh
from simtest.surfaces.recipe import load_recipe
from simtest.validation.runner import run_experiment
from simtest.validation.statistics import summarise

Works = dict[float, Callable[[], object]]

EDGES_MM = (2.4, 1.7, 1.2, 0.85, 0.6, 0.42)
WIDTH, HEIGHT = 1280, 720
"""Of the pictures with more and more highlights."""

WIDTHS = (160, 240, 320, 480, 640, 960, 1280)
REALISATIONS = 20
SPOTS = (4, 8, 16, 32, 64, 128)
WAVELENGTHS_MM = (2.8, 2.0, 1.4, 1.0, 0.7, 0.5)
COPIES = (4, 16, 64, 128, 256)
SETTINGS = (1, 2, 4, 8, 16)
"""Copies of the rows, as further realisations or as further settings."""


@dataclass(frozen=True)
class Piece:
    """Work that is done at several sizes.

    `name`: what is done; `axis`: what the sizes count; `opened`: returns a context manager that gives the work by
    its size, sizes rising.
    """

    name: str
    axis: str
    opened: Callable[[], AbstractContextManager[Mapping[float, Callable[[], object]]]]


def pieces() -> Iterator[Piece]:
    """Return all pieces, the axes in the order of the table."""
    yield Piece("mesh and curvatures of a colon", "triangles", _meshes)
    yield Piece("scene built, labelled frame and highlights of a colon", "triangles", _scenes)
    for name, work in _OF_A_VIEW.items():
        yield Piece(name, "pixels", _views(work))
    yield Piece("detection in a colour picture", "highlights", _pictures(False))
    yield Piece("detection and all normals in a colour picture", "highlights", _pictures(True))
    yield Piece("true highlights of a surface with relief", "highlights", _glints)
    for name, of_rows in _OF_ROWS.items():
        yield Piece(name, "rows", _results(of_rows, False))
        yield Piece(name, "settings", _results(of_rows, True))
    yield Piece("page of a run", "rows", _pages)


# Triangles ----------------------------------------------------------------------------------------------------------


@contextmanager
def _meshes() -> Iterator[Works]:
    """Build meshes whose seeds are always new: a mesh that is kept from before would cost nothing."""
    seeds = count(10**6)

    def build(edge_mm: float) -> int:
        return len(make_mesh(load_recipe(find("colon", "meshes"), {"seed": next(seeds)}), edge_mm)[0].faces)

    yield {float(build(edge)): lambda edge=edge: build(edge) for edge in EDGES_MM}  # type: ignore[misc]


@contextmanager
def _scenes() -> Iterator[Works]:
    """Build the renderer's scene anew, and render; the mesh is given as a file of triangles and is kept."""
    import trimesh

    with tempfile.TemporaryDirectory() as folder:
        works: Works = {}
        for edge in EDGES_MM:
            mesh, _, _ = make_mesh(load_recipe(find("colon", "meshes")), edge)
            path = Path(folder) / f"{edge}.ply"
            trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
            scene = smooth_scene(path=str(path), kind="lumen", subdivisions=0)
            works[float(len(mesh.faces))] = lambda scene=scene: _rendered(scene)  # type: ignore[misc]
        yield works
    forget_meshes()


def _rendered(scene: Scene) -> None:
    session = Session(scene, labelled=True)
    session.highlights(session.frame().radiance)
    backend.release_memory()


# Pixels -------------------------------------------------------------------------------------------------------------


def _labelled(session: Session) -> Callable[[], object]:
    return session.frame


def _searched(session: Session) -> Callable[[], object]:
    radiance = session.radiance()

    def work() -> object:
        # A session searches once for each light and camera.
        session._forget_misfits()
        return session.highlights(radiance)

    return work


def _truth(session: Session) -> Callable[[], object]:
    def work() -> object:
        session._truth = None
        return session.truth()

    return work


def _seen(session: Session) -> Callable[[], object]:
    """Pass a frame through the whole chain of a colonoscope: mosaic, noise, sharpening and JPEG."""
    radiance = session.radiance()
    scene = session.scene.model_copy(update={"sensor": Sensor.model_validate({"preset": "colonoscope_hd"})})
    return lambda: render_picture(session, scene, radiance)


_OF_A_VIEW = {
    "labelled frame of 16 samples": _labelled,
    "true highlights": _searched,
    "exact truth": _truth,
    "camera chain of a colonoscope": _seen,
}


def _views(work: Callable[[Session], Callable[[], object]]) -> Callable[[], AbstractContextManager[Works]]:
    @contextmanager
    def opened() -> Iterator[Works]:
        works: Works = {}
        for width in WIDTHS:
            size = {"width": width, "height": width * 3 // 4, "fx": width * 0.625, "fy": width * 0.625}
            works[float(size["width"] * size["height"])] = work(Session(smooth_scene(camera=size), labelled=True))
        yield works

    return opened


# Highlights ---------------------------------------------------------------------------------------------------------


def _spotted(highlights: int) -> Image:
    """Return shaded, mottled tissue in a round view, 8 bits, with highlights of 2 to 4 px spread evenly over it."""
    columns = int(np.ceil(np.sqrt(highlights * 1.6)))
    across, down = 860 / columns, 540 / -(-highlights // columns)
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    shading = 0.35 + 0.2 * np.sin(x / 170) * np.cos(y / 130)
    linear = shading[..., None] * np.array([0.55, 0.28, 0.22])
    for i in range(highlights):
        column = 210 + across * (i % columns + 0.5) + rng.uniform(-0.1 * across, 0.1 * across)
        row = 90 + down * (i // columns + 0.5) + rng.uniform(-0.1 * down, 0.1 * down)
        wide, high = rng.uniform(2, 4, 2)
        spot = np.exp(-0.5 * (((x - column) / wide) ** 2 + ((y - row) / max(high, wide / 2)) ** 2))
        linear += rng.uniform(0.4, 1.2) * spot[..., None]
    linear += rng.normal(0, 0.004, linear.shape)
    linear[np.hypot(x - WIDTH / 2, y - HEIGHT / 2) > 560] = 0.002
    return (np.rint(255 * srgb_encode(np.clip(linear, 0, 1))) / 255).astype(np.float32)


def _pictures(normals: bool) -> Callable[[], AbstractContextManager[Works]]:
    @contextmanager
    def opened() -> Iterator[Works]:
        works: Works = {}
        calibration = Calibration(Camera.from_fov(70.0, WIDTH, HEIGHT))
        names = default_estimators(calibration)

        def normals_of(picture: Image) -> object:
            return reconstruct(picture, calibration, names, detector="colour", encoding="srgb")

        for spots in SPOTS:
            picture = _spotted(spots)
            found = len(detect_in_picture(picture).detection.highlights)
            if normals:
                works[float(found)] = lambda p=picture: normals_of(p)  # type: ignore[misc]
            else:
                works[float(found)] = lambda p=picture: detect_in_picture(p)  # type: ignore[misc]
        yield works

    return opened


@contextmanager
def _glints() -> Iterator[Works]:
    """Search for the glints of ever finer reliefs: there are more, the finer it is."""
    works: Works = {}
    for wavelength in WAVELENGTHS_MM:
        relief = {"bands": [{"slope_deg": 5.0, "wavelength_mm": wavelength}]}
        session = Session(smooth_scene(1, relief=relief), labelled=True)
        radiance = session.radiance()

        def search(session: Session = session, radiance: object = radiance) -> int:
            session._forget_misfits()
            return len(session.highlights(radiance))  # type: ignore[arg-type]

        works[float(search())] = search
    yield dict(sorted(works.items()))


# Rows ---------------------------------------------------------------------------------------------------------------


def _rows(folder: Path, copies: int, settings: bool = False) -> pl.DataFrame:
    """Return real rows of the published protocol, and copies with disturbed errors: other realisations, or settings."""
    run = run_experiment(load_experiment("paper", {"realisations": REALISATIONS}), folder)
    rng = from_integer(1)
    parts = []
    for number in range(copies):
        factor = pl.Series(rng.lognormal(0, 0.1, run.results.height))
        other = pl.col("realisation") + number * REALISATIONS
        if settings:
            other = pl.format("{} {}", "setting", pl.lit(number)).alias("setting")
        parts.append(run.results.with_columns(other, pl.col("error_deg", "error_oracle_deg") * factor))
    return pl.concat(parts)


_OF_ROWS: dict[str, Callable[[pl.DataFrame], Callable[[], object]]] = {
    "summary of results": lambda rows: lambda: summarise(rows),
}


def _results(
    work: Callable[[pl.DataFrame], Callable[[], object]], settings: bool
) -> Callable[[], AbstractContextManager[Works]]:
    @contextmanager
    def opened() -> Iterator[Works]:
        with tempfile.TemporaryDirectory() as folder:
            numbers = SETTINGS if settings else COPIES
            rows = (_rows(Path(folder) / "run", number, settings) for number in numbers)
            yield {float(own["setting"].n_unique() if settings else own.height): work(own) for own in rows}

    return opened


@contextmanager
def _pages() -> Iterator[Works]:
    """Write the page of a run whose results have more and more rows; always the same figures and gallery."""
    with tempfile.TemporaryDirectory() as folder:
        works: Works = {}
        made = Path(folder) / "run"
        for copies in COPIES:
            # A folder each, in which the rows take the place of the run's own.
            rows, run = _rows(made, copies), Path(folder) / str(copies)
            shutil.copytree(made, run)
            rows.write_parquet(run / "results.parquet")
            works[float(rows.height)] = lambda run=run: _reported(run)  # type: ignore[misc]
        yield works


def _reported(run: Path) -> None:
    """Write the page of a run as if there were none yet."""
    (run / "index.html").unlink(missing_ok=True)
    shutil.rmtree(run / "figures", ignore_errors=True)
    write_report(run)
