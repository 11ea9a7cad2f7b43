"""Draw the manual's diagrams: vector pictures with their text as text, on a white ground.

Shapes that stand for numbers are computed: rays and normals, isophotes, glints, the parts of an uncertainty, imports.
What is fixed stands in diagrams.toml.
"""

import re
import tomllib
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates
from skimage.measure import find_contours

import simtest
from simtest.geometry.cones import cone_axes
from simtest.geometry.ellipse_fit import ellipse_of_conic, fit_ellipse
from simtest.pages.style import ESTIMATOR_COLOURS, LIGHT, NEUTRAL
from studies.manual.blocks import ROOT

INK, SLATE, HAIRLINE, WHITE, NIGHT = "#20272e", "#5d6770", "#cfd6dc", "#ffffff", "#14171b"
BLUE, VERMILION, GREEN, PINK, SKY, AMBER, _, BROWN = ESTIMATOR_COLOURS.values()
COLOURS = {
    "ink": INK, "slate": SLATE, "hairline": HAIRLINE, "grey": NEUTRAL, "blue": BLUE, "vermilion": VERMILION,
    "green": GREEN, "amber": AMBER, "pink": PINK, "sky": SKY, "brown": BROWN,
}  # fmt: skip
WIDTH = 760
SHEETS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
Points = Sequence[Sequence[float]] | np.ndarray


def pale(colour: str, share: float = 0.12) -> str:
    """Return a colour mixed with white, of which it keeps a share."""
    parts = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return "#" + "".join(f"{round(255 - share * (255 - part)):02x}" for part in parts)


def unit(vector: np.ndarray) -> np.ndarray:
    """Return vectors scaled to length 1."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def ring(centre: Points, width: float, height: float, turn: float = 0.0) -> np.ndarray:
    """Return an ellipse with these half axes, turned by an angle, rad."""
    angle = np.linspace(0, 2 * np.pi, 49)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.stack([width * np.cos(angle), height * np.sin(angle)], axis=1) @ axes + centre


class Drawing:
    """A picture that is drawn piece by piece, with a sheet of rows on top; lengths in px, y down."""

    def __init__(self, name: str) -> None:
        self.sheet = SHEETS[name]
        self.parts: list[str] = []

    def text(
        self, at: Points, text: str, colour: str = INK, size: float = 12.5, anchor: str = "start", bold: bool = False
    ) -> None:
        """Write lines of text, the first one's baseline at a point."""
        style = f'text-anchor="{anchor}" font-size="{size:g}" fill="{colour}"' + ' font-weight="bold"' * bold
        for number, line in enumerate(text.split("\n")):
            place = f'x="{at[0]:.1f}" y="{at[1] + 1.3 * size * number:.1f}"'
            self.parts.append(f"<text {place} {style}>{escape(line, quote=False)}</text>")

    def line(self, points: Points, colour: str = INK, width: float = 1.2, dash: str = "", fill: str = "none") -> None:
        """Draw a curve through points, or fill the area that it encloses."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z" * (fill != "none")
        dashes = f' stroke-dasharray="{dash}"' * bool(dash)
        self.parts.append(f'<path d="{path}" fill="{fill}" stroke="{colour}" stroke-width="{width:g}"{dashes}/>')

    def arrow(self, points: Points, colour: str = INK, width: float = 1.6, dash: str = "") -> None:
        """Draw a curve with a head at its end."""
        *others, last, end = np.asarray(points, float)
        along = unit(end - last)
        across = np.array([-along[1], along[0]])
        self.line([*others, last, end - 9 * along], colour, width, dash)
        self.line([end, end - 9 * along + 4 * across, end - 9 * along - 4 * across], "none", fill=colour)

    def circle(self, at: Points, radius: float, fill: str, colour: str = "none") -> None:
        """Draw a disc."""
        self.parts.append(f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:g}" fill="{fill}" stroke="{colour}"/>')

    def rect(
        self, x: float, y: float, width: float, height: float, fill: str, colour: str = "none", radius: float = 6
    ) -> None:
        """Draw a rectangle with round corners."""
        place = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="{radius:g}"'
        self.parts.append(f'<rect {place} fill="{fill}" stroke="{colour}"/>')

    def box(self, x: float, y: float, width: float, height: float, text: str, colour: str = BLUE) -> None:
        """Draw a box; of several lines of text the first one is bold."""
        self.rect(x, y, width, height, pale(colour), colour)
        head, *rest = text.split("\n")
        middle, top = x + width / 2, y + height / 2 + 4.5 - 8 * len(rest)
        self.text((middle, top), head, size=13, anchor="middle", bold=bool(rest))
        if rest:
            self.text((middle, top + 17), "\n".join(rest), size=12, anchor="middle")

    def row(self, row: str) -> None:
        """Draw a row of a sheet: a kind, its numbers, points, colour and marks; its lines of text follow after bars."""
        head, *lines = (part.strip() for part in row.split("|"))
        kind, *words = head.split()
        numbers = [float(word) for word in words if re.fullmatch(r"[\d.]+", word)]
        points = [tuple(map(float, word.split(","))) for word in words if "," in word]
        colour = next((COLOURS[word] for word in words if word in COLOURS), INK)
        anchor = next((word for word in words if word in ("middle", "end")), "start")
        if kind == "box":
            self.box(*numbers, "\n".join(lines), colour)
        elif kind == "area":
            self.rect(*numbers, pale(colour, 0.07), pale(colour, 0.5), 10)
        elif kind == "text":
            self.text(numbers[:2], "\n".join(lines), colour, *numbers[2:] or [12.5], anchor, "bold" in words)
        else:
            draw = self.arrow if kind == "arrow" else self.line
            draw(points, colour, *numbers or [1.6], "5 4" if "dashed" in words else "")

    def camera(self, at: Points, turn: float = 0.0) -> None:
        """Draw a camera, its centre at a point, looking right or turned clockwise by an angle, rad."""
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        body = np.array([[-26, -9], [-8, -9], [0, -3], [0, 3], [-8, 9], [-26, 9]]) @ rotation
        self.line(body + at, INK, fill=SLATE)

    def light(self, at: Points, radius: float = 7) -> None:
        """Draw a light."""
        for angle in np.arange(8) * np.pi / 4:
            step = np.array([np.cos(angle), np.sin(angle)])
            self.line([(radius + 2) * step + at, (radius + 6) * step + at], AMBER, 1.5)
        self.circle(at, radius, LIGHT, AMBER)

    def svg(self) -> str:
        """Return the picture as a document."""
        height = self.sheet["height"]
        computed, self.parts = self.parts, []
        self.rect(0.5, 0.5, WIDTH - 1, height - 1, WHITE, HAIRLINE, 10)
        self.parts += computed
        for row in self.sheet["rows"].strip().splitlines():
            self.row(row)
        size = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" role="img">'
        return "\n".join([head, f"<title>{escape(self.sheet['title'])}</title>", *self.parts, "</svg>\n"])


def geometry(drawing: Drawing) -> None:
    """Draw light, camera, the brightest point and a point beside it, in a plane that holds all of them."""
    camera, light = np.array([120.0, 262.0]), np.array([120.0, 120.0])
    y = np.linspace(36, 396, 361)
    surface = np.stack([590 + (y - 367) ** 2 / 2000, y], axis=1)
    normal = unit(np.stack([-np.ones_like(y), (y - 367) / 1000], axis=1))
    to_camera, to_light = unit(camera - surface), unit(light - surface)
    half = unit(to_camera + to_light)
    mirror = 2 * (normal * to_light).sum(axis=1, keepdims=True) * normal - to_light
    drawing.line([*surface[::10], (736, 396), (736, 36)], "none", fill=pale(VERMILION, 0.16))
    drawing.line(surface[::10], VERMILION, 2.5)
    drawing.rect(30, 84, 100, 216, "#eef1f4", HAIRLINE, 14)

    def angle(number: int, start: np.ndarray, end: np.ndarray, radius: float, label: str) -> None:
        across = start[number] + np.linspace(0, 1, 12)[:, None] * (end[number] - start[number])
        drawing.line(surface[number] + radius * unit(across))
        drawing.text(
            surface[number] + (radius + 15) * unit(start[number] + end[number]) + [0, 5], label, INK, 14, "middle"
        )

    # At a point beside the BP the mirror direction of the light misses the camera.
    aside, bp = 286, int(np.argmax((normal * half).sum(axis=1)))
    for number, width, dash, length in ((aside, 1.2, "5 4", 80), (bp, 2, "", 250)):
        drawing.line([light, surface[number]], AMBER, width, dash)
        drawing.line([camera, surface[number]], BLUE, width, dash)
        drawing.arrow([surface[number], surface[number] + length * normal[number]], GREEN, 1.2 * width)
    drawing.arrow([surface[aside], surface[aside] + 190 * mirror[aside]], VERMILION, 1.8)
    angle(aside, to_camera, mirror, 105, "β")
    angle(bp, to_light, half, 170, "α")
    angle(bp, half, to_camera, 176, "α")
    drawing.circle(surface[aside], 4, WHITE, INK)
    drawing.circle(surface[bp], 5, INK)
    drawing.text(surface[bp] + [14, -2], "brightest\npoint (BP)", bold=True)
    drawing.text(surface[aside] + [12, 5], "point beside it")
    drawing.text(
        surface[aside] + 196 * mirror[aside] + [0, 6], "mirror direction of the light", VERMILION, anchor="end"
    )
    drawing.text(surface[bp] + 256 * normal[bp] + [0, 5], "normal N", GREEN, 14, "end", True)
    drawing.light(light)
    drawing.camera(camera)


def isophotes(drawing: Drawing) -> None:
    """Draw level curves of a highlight on three surfaces, from the side and as the camera sees them."""
    light, distance, exponent, focal = np.array([0.2, 0.0, 0.0]), 10.0, 60, 300.0
    sight = unit(np.array([0.25, 0.12, 1.0]))
    first = unit(np.cross([0.35, 1.0, 0.0], sight))
    second = np.cross(sight, first)
    step = np.linspace(-3, 3, 241)
    a, b = np.meshgrid(step, step)
    surfaces = {
        "plane": (0 * a, "1 + d k = 1 and 1"),
        "cylinder": (10 - np.sqrt(100 - b**2), "1 + d k = 1 and 2"),
        "saddle": ((a**2 - b**2) / 40, "1 + d k = 1.5 and 0.5"),
    }
    # The side view: z runs down, turned and tipped.
    side = 20 * np.array([[0.86, 0.5, 0.0], [-0.25, 0.43, 0.85]])
    for column, (name, (height, gains)) in enumerate(surfaces.items()):
        left = 17 + 248 * column
        surface = distance * sight + np.stack([a, b, height], axis=-1) @ [first, second, sight]
        over_b, over_a = np.gradient(height, step, step)
        normal = unit(np.stack([over_a, over_b, -np.ones_like(a)], axis=-1) @ [first, second, sight])
        to_light, to_camera = unit(light - surface), unit(-surface)
        mirror = 2 * (normal * to_light).sum(axis=-1, keepdims=True) * normal - to_light
        bright = (mirror * to_camera).sum(axis=-1).clip(0) ** exponent / (surface**2).sum(axis=-1)
        peak = np.unravel_index(bright.argmax(), bright.shape)
        matrix = np.array([[focal, 0, left + 40], [0, focal, 404], [0, 0, 1]])
        corner = np.array([left + 64, 84])
        drawing.text((left + 115, 32), name, INK, 15, "middle", True)
        drawing.text((left + 115, 51), gains, NEUTRAL, 12, "middle")
        drawing.rect(left, 352, 230, 176, NIGHT, radius=4)
        rim = np.concatenate([surface[0], surface[:, -1], surface[-1, ::-1], surface[::-1, 0]])
        drawing.line(rim[::12] @ side.T + corner, VERMILION, fill=pale(VERMILION))
        for mesh in (*surface[::40], *surface.swapaxes(0, 1)[::40]):
            drawing.line(mesh[::12] @ side.T + corner, pale(VERMILION, 0.45), 0.7)
        for isovalue in (0.15, 0.3, 0.5, 0.7, 0.9):
            (curve,) = find_contours(bright / bright.max(), isovalue)
            points = np.stack([map_coordinates(surface[..., i], curve.T) for i in range(3)], axis=1)
            pixels = (points @ matrix.T)[:, :2] / points[:, 2:]
            fewer = np.linspace(0, len(points) - 1, 64).astype(int)
            drawing.line(points[fewer] @ side.T + corner, BLUE, 1.3)
            drawing.line(pixels[fewer], "#8cc6e3", 1.3)
            if isovalue == 0.5:
                conic = fit_ellipse(pixels).image
        ellipse = ellipse_of_conic(conic)
        x, y = ellipse.centre
        drawing.line(ring(ellipse.centre, ellipse.semi_major, ellipse.semi_minor, ellipse.angle), LIGHT, 2.2, "6 4")
        drawing.line([(x - 5, y - 5), (x + 5, y + 5), (x, y), (x - 5, y + 5), (x + 5, y - 5)], LIGHT, 1.8)
        bp, axis = surface[peak], cone_axes(matrix.T @ conic @ matrix)[1][:, 2]
        drawing.line([corner, bp @ side.T + corner], NEUTRAL, 1, "3 3")
        drawing.arrow([bp @ side.T + corner, (bp - 4.5 * axis) @ side.T + corner], GREEN, 2.4)
        drawing.camera(corner, float(np.arctan2(*(bp @ side.T)[::-1])))
        ratio, off = ellipse.semi_minor / ellipse.semi_major, np.degrees(np.arccos(-axis @ normal[peak]))
        drawing.text((left + 115, 546), f"axis ratio {ratio:.2f}, normal {off:.1f}° off", anchor="middle")
    drawing.line([(250, 566), (278, 566)], LIGHT, 2.4, "6 4")


def given_and_not() -> list[dict[str, float]]:
    """Return the parts of a picture's uncertainty, deg, without a calibration and with one.

    The same as `simtest render tissue_colon` with one light 3 mm beside the camera, and `simtest reconstruct --target
    base` with `--fov 90` and with `--camera calibration.toml`.
    """
    frame = simtest.render("tissue_colon", {"rig.lights": [{"offset_mm": 3.0}]})
    picture = np.round(255 * frame.image).astype(np.uint8)
    found = (simtest.reconstruct(picture, known, target="base") for known in (90.0, frame.calibration))
    return [each.to_json()["stated_of_organ"].parts_deg for each in found]


def budget(drawing: Drawing) -> None:
    """Draw the parts of the uncertainty of one picture's normals, on a logarithmic scale."""
    meanings = {
        "relief": "slope of the relief over the organ",
        "light_offset": "a light somewhere beside the camera",
        "distance": "distance of the tissue",
        "camera": "focal length, centre, distortion",
        "shape": "curvature that changes; near misses",
        "resolution": "pixels, lens, mosaic, coding",
        "response": "encoding, falloff to the border",
        "noise": "the sensor's noise",
    }
    without, calibrated = given_and_not()
    left, right, lowest = 300, 724, -4.0

    def place(degrees: float) -> float:
        return left + (np.log10(degrees) - lowest) / (1.6 - lowest) * (right - left)

    for power in range(-4, 2):
        drawing.line([(place(10.0**power), 84), (place(10.0**power), 430)], HAIRLINE, 1)
        drawing.text((place(10.0**power), 448), f"{10.0**power:g}°", NEUTRAL, 12, "middle")
    for number, (part, meaning) in enumerate(meanings.items()):
        y = 104 + 43 * number
        drawing.text((24, y - 2), part, size=13.5, bold=True)
        drawing.text((24, y + 15), meaning)
        for values, colour, shift in ((without, VERMILION, -7), (calibrated, BLUE, 7)):
            end = (place(max(values.get(part, 0), 10**lowest)), y + shift)
            drawing.line([(left, y + shift), end], pale(colour, 0.45), 4)
            if end[0] > left:
                drawing.circle(end, 5.5, colour)
            label = f"{values[part]:.2g}°" if end[0] > left else "none"
            drawing.text((end[0] + 10, end[1] + 4), label, colour, 12)
    drawing.circle((30, 58), 5.5, VERMILION)
    drawing.circle((260, 58), 5.5, BLUE)


def glitter(drawing: Drawing) -> None:
    """Draw a rough surface below a light and a camera, which of its facets glint, and how dense glints lie."""
    camera, x = np.array([470.0, 74.0]), np.linspace(20, 740, 1441)
    base = 326 + (x - 230) ** 2 / 5000
    base_slope = (x - 230) / 2500
    generator = np.random.default_rng(8)
    # Waves of 24 to 60 px whose slopes add to 13 deg rms.
    number = 2 * np.pi / np.linspace(24, 60, 24)
    size = np.radians(13) * np.sqrt(2 / len(number)) / number

    def relief() -> tuple[np.ndarray, np.ndarray]:
        phase = number * x[:, None] + generator.uniform(0, 2 * np.pi, len(number))
        return (size * np.sin(phase)).sum(axis=1), (size * number * np.cos(phase)).sum(axis=1)

    def glints(height: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return where the normal, (slope, -1), points at the camera."""
        miss = (base_slope + slope) * (camera[1] - base - height) + camera[0] - x
        return np.flatnonzero(np.diff(np.sign(miss)))

    (bp,) = glints(0 * x, 0 * x)
    height, slope = relief()
    shining = glints(height, slope)
    fine = np.stack([x, base + height], axis=1)
    drawing.line([*fine[::3], (740, 408), (20, 408)], "none", fill=pale(VERMILION, 0.16))
    drawing.line(np.stack([x, base], axis=1)[::20], NEUTRAL, 1.2, "6 4")
    for place in range(20, len(x), 40):
        facet = unit(np.array([base_slope[place] + slope[place], -1.0]))
        drawing.line([fine[place], fine[place] + 16 * facet], NEUTRAL, 1)
    for place in shining:
        drawing.line([camera, fine[place]], pale(LIGHT, 0.8), 1)
    drawing.line(fine[::3], VERMILION, 1.6)
    for place in shining:
        drawing.circle(fine[place], 4, LIGHT, AMBER)
    foot = np.array([x[bp], base[bp]])
    drawing.arrow([foot, foot + 150 * unit(np.array([base_slope[bp], -1.0]))], GREEN, 2.6)
    drawing.circle(foot, 4.5, GREEN)
    drawing.camera(camera, np.pi / 2)
    drawing.light(camera + np.array([18, -8]), 6)
    drawing.circle((30, 50), 4, LIGHT, AMBER)
    # What many such reliefs make: the density of glints.
    places = np.concatenate([x[glints(*relief())] for _ in range(3000)])
    counts, edges = np.histogram(places, np.arange(20, 741, 12))
    for count, edge in zip(counts / counts.max(), edges, strict=False):
        drawing.rect(edge + 1, 500 - 80 * count, 10, 80 * count, pale(BLUE, 0.45), radius=0)
    for place in shining:
        drawing.line([(x[place], 500), (x[place], 508)], AMBER, 2.4)
    drawing.line([foot, (foot[0], 508)], GREEN, 1.4, "5 4")


def detection(drawing: Drawing) -> None:
    """Draw the way from a picture to the highlights that are answered: steps, the rule of saddles, kinds."""
    # Specular light along a row of the picture: two summits that stay apart, two that are one cluster.
    x = np.linspace(0, 350, 71)
    lobes = ((70, 100, 22), (157, 74, 18), (252, 88, 16), (296, 80, 15))
    light = 8 + sum(height * np.exp(-(((x - place) / width) ** 2) / 2) for place, height, width in lobes)
    row = np.stack([35 + x, 280 - light], axis=1)
    drawing.line([*row, (385, 288), (35, 288)], "none", fill=pale(BLUE))
    drawing.line(row, BLUE, 2)
    drawing.circle(row[24], 4, WHITE, GREEN)
    drawing.circle(row[55], 4, WHITE, VERMILION)
    for isovalue in (0.5, 0.65, 0.8):
        size = 66 * np.sqrt(-np.log2(isovalue))
        drawing.line(ring((520, 208), size, 0.62 * size, 0.3), BLUE, 1.6, fill=pale(BLUE, 0.1))
    drawing.circle((520, 208), 3, INK)
    kinds = {
        "isolated": "closed, elliptic, nested",
        "clipped": "half of it or more is clipped",
        "small": "fewer than 12 pixels",
        "cluster": "summits in one outline",
        "elongated": "axis ratio below 0.12",
        "merged": "isophotes are no ellipses",
        "border": "cut by the view's border",
        "inter_reflection": "has the tissue's tint",
        "unclear": "faint, or among\nother bright things",
    }
    for number, (kind, reason) in enumerate(kinds.items()):
        left, top = 20 + 246 * (number % 3), (350, 442, 508)[number // 3]
        drawing.rect(left, top, 58, 58, NIGHT, radius=4)
        spot(drawing, kind, left + 29, top + 29)
        drawing.text((left + 68, top + 24), kind, size=13, bold=True)
        drawing.text((left + 68, top + 42), reason, size=12)


def spot(drawing: Drawing, kind: str, x: float, y: float) -> None:
    """Draw a highlight of a kind on a dark tile of 58 px."""
    bright, glow = "#ffffff", "#6f7880"
    shapes = {
        "isolated": [(0, 0, 15, 11, glow), (0, 0, 9, 6.5, "#b6bdc3"), (0, 0, 4, 3, bright)],
        "clipped": [(0, 0, 17, 13, glow), (0, 0, 14, 10, bright)],
        "small": [(0, 0, 3, 3, bright)],
        "cluster": [(-8, -4, 13, 10, glow), (7, 5, 13, 10, glow), (-8, -4, 5, 4, bright), (7, 5, 5, 4, bright)],
        "elongated": [(0, 0, 26, 4, glow), (0, 0, 20, 1.8, bright)],
        "merged": [(-6, -5, 14, 9, glow), (5, 6, 7, 15, glow), (-2, 0, 5, 5, bright)],
        "border": [(29, 0, 16, 14, glow), (29, 0, 9, 7, bright)],
        "inter_reflection": [(0, 0, 15, 11, "#8c4a3c"), (0, 0, 8, 6, "#d98a78")],
        "unclear": [(0, 0, 12, 9, "#333a41"), (-16, 13, 6, 3, "#4a525a"), (17, -13, 4, 6, "#4a525a")],
    }
    for across, down, width, height, colour in shapes[kind]:
        outline = ring((x + across, y + down), width, height)
        drawing.line(np.stack([outline[:, 0].clip(x - 29, x + 29), outline[:, 1]], axis=1), "none", fill=colour)


MEANINGS = {
    "cli": "commands, one a file",
    "api": "functions behind the commands",
    "nightly": "measures, judges, draws",
    "bench": "the frozen benchmark",
    "advice": "what a scope can reach; twins",
    "report": "figures and page of a run",
    "realism": "distance to real frames",
    "dataset": "labelled frames on disk",
    "validation": "experiments, errors, laws",
    "simulation": "labelled frames; the sensor",
    "inverse": "differentiates the renderer",
    "reconstruction": "picture to normals",
    "detection": "where highlights are",
    "estimators": "highlight to normal",
    "rendering": "scene to radiance",
    "surfaces": "exact shapes, relief",
    "spec": "scene files and their checks",
    "calibration": "light, response, priors",
    "pages": "charts, tables, sections",
    "geometry": "cameras, isophotes, ellipses",
    "runtime": "files, seeds, processes",
    "errors": "refusals and failures",
    "conventions": "axes, pixels, signs",
}
"""What each package is for, in a few words."""


def imports_of(package: str) -> set[str]:
    """Return the packages that a package of simtest imports."""
    folder = ROOT / "simtest" / package
    files = folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]
    return {
        name for file in files for name in re.findall(r"^\s*(?:from|import) simtest\.(\w+)", file.read_text(), re.M)
    }


def layers(drawing: Drawing) -> None:
    """Draw the packages by layer, and which imports which."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    order, forbidden, _, mitsuba = project["tool"]["importlinter"]["contracts"]
    rows = [[name.strip().removeprefix("simtest.") for name in layer.split("|")] for layer in order["layers"]]
    names = [name for row in rows for name in row]
    blind = {name.removeprefix("simtest.") for name in forbidden["source_modules"]}
    may_render = {name for name in names if f"simtest.{name}" not in mitsuba["source_modules"]}
    for x, colour in ((20, GREEN), (184, VERMILION), (338, BLUE)):
        drawing.rect(x, 48, 12, 12, pale(colour, 0.3), colour, 3)
    top, left, step, row_of = 150, 330, 17, {name: number for number, row in enumerate(rows) for name in row}
    for number, name in enumerate(names):
        x, y = left + step * number, top + 21 * number
        drawing.text((x + 12, top - 8), name, size=12)
        drawing.parts[-1] = drawing.parts[-1].replace("<text", f'<text transform="rotate(-60 {x + 12} {top - 8})"')
        drawing.rect(14, y, WIDTH - 28, 21, "#f3f5f7" if row_of[name] % 2 else WHITE, radius=0)
        colour = GREEN if name in blind else VERMILION if name in may_render else BLUE
        drawing.rect(20, y + 2, 112, 17, pale(colour, 0.22), colour, 4)
        drawing.text((76, y + 15), name, anchor="middle")
        drawing.text((140, y + 15), MEANINGS[name], size=12)
        drawing.rect(x + 3.5, y + 5.5, 10, 10, HAIRLINE, radius=2)
        imported = imports_of(name) - {name}
        for column, other in enumerate(names):
            if other in imported:
                drawing.circle((left + step * column + step / 2, y + 10.5), 4.5, colour)


def gate(drawing: Drawing) -> None:
    """Draw intervals of a difference beside the margin, above the pairs that they come from."""
    drawing.rect(24, 162, 712, 204, "#f7f9fa", HAIRLINE)
    middle, margin = 520, 34
    drawing.rect(middle - margin, 196, 2 * margin, 136, pale(GREEN, 0.18), radius=0)
    cases = (
        ("equivalent", 6, 14, GREEN),
        ("undecided", 26, 36, SLATE),
        ("worse", 86, 26, VERMILION),
        ("better", -78, 22, BLUE),
    )
    samples = np.random.default_rng(5).normal(0, 0.8, (4, 9))
    for number, (label, centre, half, colour) in enumerate(cases):
        x, y = middle + centre, 216 + 32 * number
        drawing.line([(x - half, y), (x + half, y)], colour, 2.4)
        drawing.circle((x, y), 4.5, colour)
        for value in samples[number]:
            drawing.circle((x + half * value, y + 10), 1.6, pale(colour, 0.7))
        drawing.text((652, y + 4), label, colour, bold=True)


COMPUTED: dict[str, Callable[[Drawing], None]] = {
    each.__name__: each for each in (geometry, isophotes, budget, glitter, detection, layers, gate)
}
"""What draws the computed part of each diagram that has one."""


def write_diagrams(folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Draw the diagrams into a folder, all of them or those of some names."""
    if unknown := set(names) - set(SHEETS):
        raise SystemExit(f"no such diagram: {', '.join(sorted(unknown))}; there are {', '.join(SHEETS)}")
    paths = [folder / f"{name}.svg" for name in SHEETS if not names or name in names]
    for path in paths:
        drawing = Drawing(path.stem)
        COMPUTED.get(path.stem, lambda drawing: None)(drawing)
        path.write_text(drawing.svg(), encoding="utf-8")
    return paths
