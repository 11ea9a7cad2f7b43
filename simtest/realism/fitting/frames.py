"""Frames of a recipe without their labels: one radiance, and pictures of it by several draws of the sensor."""

from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import JsonValue

from simtest.dataset.maker import colour_variant
from simtest.dataset.plan import Anatomy, Drawn, Plan
from simtest.errors import InputError
from simtest.rendering import Session
from simtest.runtime.arrays import Image, only_reading
from simtest.runtime.seeds import Stage, generator, integer
from simtest.simulation.frame import render_picture
from simtest.simulation.sensor import displayed
from simtest.spec import Scene, apply_settings
from simtest.spec.recipes import Dataset
from simtest.spec.sensor import Sensor

TRIES = 8
"""Draws of a frame before one that cannot be placed is given up."""


@dataclass(frozen=True)
class DrawnFrame:
    """A picture of a recipe and what was drawn for it.

    Parameters
    ----------
    index, chain : int
        Number of the radiance, and of the sensor's draw.
    anatomy : Anatomy
        What it shows.
    values : dict
        Drawn values by key path.
    picture : ndarray of float32, shape (H, W, 3)
        Encoded values in [0, 1].
    """

    index: int
    chain: int
    anatomy: Anatomy
    values: dict[str, JsonValue]
    picture: Image


class FrameMaker:
    """Renders frames of a recipe, without the labels of `simtest dataset`.

    Parameters
    ----------
    dataset : Dataset
        The recipe; all its ranges are drawn.
    variant : str, optional
        Mitsuba variant.
    """

    def __init__(self, dataset: Dataset, variant: str | None = None) -> None:
        self.dataset = dataset
        self.plan = Plan(dataset)
        self._variant = colour_variant(variant)
        self._session: Session | None = None
        self._anatomy: Anatomy | None = None

    def frames(self, index: int, chains: int) -> Iterator[DrawnFrame]:
        """Render one radiance and yield its pictures, each by another draw of the sensor; the first is the sample's."""
        drawn = self.plan.draw(index)
        for attempt in range(1, TRIES + 1):
            try:
                session = self._at(drawn.anatomy, drawn.scene)
                break
            except InputError:
                # A drawn camera or light may stand in the wall: the recipe itself draws again too.
                if attempt == TRIES:
                    raise
                drawn = self.plan.draw(index, attempt)
        radiance = session.radiance()
        for chain in range(chains):
            values, scene = (drawn.values, drawn.scene) if chain == 0 else self._redrawn(index, chain, drawn)
            picture = displayed(render_picture(session, scene, radiance), scene.sensor)
            yield DrawnFrame(index, chain, drawn.anatomy, values, picture)

    def _redrawn(self, index: int, chain: int, drawn: Drawn) -> tuple[dict[str, JsonValue], Scene]:
        """Draw the sensor's values again, with other noise."""
        family, name, seed = self.dataset.families[drawn.anatomy.family], self.dataset.name, self.dataset.seed
        rng = generator(seed, name, f"chain {chain}", index, Stage.SENSOR)
        tables = {**family.per_anatomy, **family.per_sample, **self.dataset.per_sample}
        values = {key: tables[key].draw(rng) for key in sorted(tables) if key.startswith("sensor.")}
        noise = {"sensor.seed": integer(seed, name, f"noise {chain}", index, Stage.SENSOR)}
        table = {"sensor": drawn.scene.sensor.model_dump(mode="json")}
        sensor = apply_settings(table, {**values, **noise}, name)["sensor"]
        scene = drawn.scene.model_copy(update={"sensor": Sensor.model_validate(sensor)})
        return drawn.values | values, scene

    def _at(self, anatomy: Anatomy, scene: Scene) -> Session:
        # Imported here: a bank that is complete needs no renderer.
        from simtest.rendering import backend
        from simtest.surfaces.factory import forget_meshes

        if self._session is not None and anatomy != self._anatomy:
            # As in `simtest dataset`: an anatomy never comes back, and neither its memory nor its files must add up.
            self._session = None
            forget_meshes()
            backend.release_memory()
        with only_reading():
            if self._session is None:
                self._session, self._anatomy = Session(scene, self._variant), anatomy
            self._session.update(scene)
        return self._session
