"""Frames of several samples a pixel that take them only where the picture is not smooth (`even_pixels`)."""

import math
from dataclasses import dataclass

import numpy as np

from simtest.rendering import even_pixels
from simtest.rendering.integrate import Progress, Tracer
from simtest.rendering.mesh_edges import MOST_LIGHTS, MeshEdges
from simtest.rendering.rays import in_tiles
from simtest.rendering.shape_labels import CHANNELS, ShapeLabels
from simtest.runtime.arrays import Image, Mask
from simtest.spec.lights import CosineProfile, LightSpec, is_at_camera
from simtest.spec.scene import Scene
from simtest.surfaces import Shape

LEAST_SAMPLES = 4
"""Fewer samples a pixel are taken everywhere."""

LEAST_RADIUS_PX = 8.0
"""An analytic shape that looks smaller than this gets all samples."""


def applies(scene: Scene) -> bool:
    """Return whether the rule for smooth pixels is made for a scene.

    Left out: bounces, which are random; sources of finite size, whose penumbrae need many rays at each centre; relief
    and the colour of tissue, which may be finer than a pixel; instruments, whose edges and shadows no label shows.
    Frames of a moving camera do not come here: each of their steps takes so few samples that the rays through the
    centres would cost more than they save.
    """
    effort, lights = scene.render, scene.rig.lights
    direct = effort.path_depth == 2 and all(light.source is None for light in lights)
    plain = scene.surface.relief is None and scene.albedo is None and not scene.shown_instruments
    enough = effort.adaptive and effort.samples_per_pixel >= LEAST_SAMPLES
    return enough and direct and plain and len(lights) <= MOST_LIGHTS


def beam(light: LightSpec) -> float:
    """Return the angle, rad, within which a light's emission may change; 1 where it is alike in all directions."""
    angles = [1.0]
    if isinstance(light.profile, CosineProfile):
        angles.append(math.sqrt(2 * math.log(2) / max(light.profile.power, 1e-9)))
    else:
        angles.append(math.radians(float(np.diff(light.profile.angle_deg).min())))
    if light.spot_deg is not None:
        angles.append(math.radians(light.spot_deg / 2))
    return min(angles)


@dataclass(frozen=True)
class Adaptive:
    """Renders the frames of one scene.

    Parameters
    ----------
    tracer : Tracer
        Of the scene.
    scene : Scene
        The scene, for which `applies` is true.
    labels : ShapeLabels
        Of its shape, without curvatures.
    shape : Shape
        The shape.
    edges : MeshEdges or None
        Of a mesh.
    """

    tracer: Tracer
    scene: Scene
    labels: ShapeLabels
    shape: Shape
    edges: MeshEdges | None

    def render(self, progress: Progress | None) -> tuple[list[Image], list[Image]]:
        """Return the channels of the mean radiance, and of the labels without curvatures, shape (H, W) each."""
        effort, camera = self.scene.render, self.tracer.sightlines.camera
        pixels = camera.width * camera.height
        total = pixels * effort.samples_per_pixel

        def begun(done: int, _: int, what: str) -> None:
            assert progress is not None
            progress(done, total, what)

        # The rays through the centres.
        clues = even_pixels.Clues(
            self.tracer.mi,
            self.labels,
            self.scene.rig.true_mm(),
            [beam(light) for light in self.scene.rig.lights],
            even_pixels.pixels_per_rad(camera),
        )
        parts, channels = self.tracer.centres(None, True, clues, begun if progress else None)
        labels, gaps, scale = clues.split(channels)
        # What follows from them, and which pixels need more.
        chosen = self._chosen(parts, labels, gaps, scale, clues.px_per_rad)
        means = [even_pixels.mean_of_pixel(part) for part in parts]
        numbers = in_tiles(chosen)
        if len(numbers):

            def went_on(traced: int) -> None:
                assert progress is not None
                share = traced / (len(numbers) * effort.samples_per_pixel)
                progress(pixels + round((total - pixels) * share), total, "rendering")

            sampled = self.tracer.means_at(
                numbers, effort.samples_per_pixel, effort.seed, went_on if progress else None
            )
            for mean, channel in zip(means, sampled, strict=True):
                mean.ravel()[numbers] = channel
        return means, labels

    def _chosen(
        self, parts: list[Image], labels: list[Image], gaps: list[Image], scale: Image, px_per_rad: float
    ) -> Mask:
        """Return the pixels that need samples."""
        camera, pose = self.tracer.sightlines.camera, self.tracer.sightlines.pose
        depth, width = labels[CHANNELS.index("depth")], self.scene.reflectance.half_width
        if self._is_small(px_per_rad):
            return np.ones(depth.shape, dtype=bool)
        chosen = even_pixels.choose(parts, depth, gaps, scale, width)
        if self.edges is not None:
            lights = [place for place in self.scene.rig.true_mm() if not is_at_camera(place)]
            chosen |= self.edges.marks(camera, pose, np.reshape(lights, (-1, 3)), depth, width, px_per_rad)
        return chosen

    def _is_small(self, px_per_rad: float) -> bool:
        """Return whether an analytic shape looks so small that centres may miss it."""
        if self.shape.kind not in ("sphere", "cylinder"):
            return False
        pose, matrix = self.tracer.sightlines.pose, self.shape.to_model
        radius = float(np.linalg.norm(matrix[:3, 0]))
        offset = np.linalg.inv(matrix)[:3] @ pose[:, 3]
        rounded = offset[: 3 if self.shape.kind == "sphere" else 2]
        distance = radius * float(np.linalg.norm(rounded))
        return radius * px_per_rad < LEAST_RADIUS_PX * distance
