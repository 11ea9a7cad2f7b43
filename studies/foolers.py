"""What is taken for a highlight and is none, and how well the score tells it apart.

    python -m studies.foolers [SHARE] [SEED] [ROWS.json]
    python -m studies.foolers --fit
    python -m studies.foolers --real FOLDER

Scenes are drawn from those in scenes/foolers, eight kinds; a part of each kind's frames carries a narrow lobe too, so
that there are true highlights among the false. Bodies are analytic ones and made meshes (`body`, `tube`); they become
sRGB pictures of 8 bits with noise, a point spread and sometimes sharpening, grey or coloured. Grey ones go to `peaks`,
coloured ones to `colour`, and one in four to `peaks`. Camera, light and distance are given, the light up to 300 mm
aside (in the tube 8 mm), in every fourth frame at the camera; `bisector` answers, with the floors of pictures. Frames
are drawn until a kind has the number of false detections, and as many true ones, that `TESTED` names, times SHARE.

**When a maximum counts as a highlight.** In the noise-free frame, before clipping and smoothed as the detection was,
light rises from the median of the pixels just outside of the detection's isophote at half height to the brightest pixel
in it. It is a highlight where at least half of that rise is direct light of the lobe, on the surface that a pixel
resolves. So a broad lobe counts where it, and not the shading, makes the isophotes; the mirror image of a lit wall does
not. In creases and at folds the normals' mean over `RESOLVED_PX` is what a pixel resolves, and a spark of anything
finer does not count. On smooth and tissue frames, which hold no foolers, glints and near misses count
(`simtest.advice.twin.scoring`).

An answer is wrong and sure where it is off by more than 5 deg and by more than three times its ±, from the normal of
the surface that a pixel resolves, where it looks. The score was fitted (`--fit`) to the kinds `FITTED`, seed 601, and
to smooth and tissue frames of that seed; features and threshold were chosen on these. Of `TRAINED`, creases and fold
edges were looked at and left out of the fit: their sparks and tissue's own small glints look alike. The kinds `TESTED`
were drawn and frozen before any of them was scored.
"""

import json
import math
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.stats import rankdata
from skimage.measure import marching_cubes

from benchmarks.measuring import print_markdown
from simtest.advice.twin.scoring import score
from simtest.calibration import Calibration, Frame, Normal, Priors, srgb_encode
from simtest.calibration.calibration import mean_channel
from simtest.calibration.priors import OF_PICTURES
from simtest.detection.score import LEAST_SCORE, NAMES, features, highlight_scores
from simtest.errors import Failure, SimtestError
from simtest.geometry import Patch
from simtest.geometry.patch import dilated, smooth
from simtest.geometry.vectors import angle_deg, unit
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import reconstruct, run
from simtest.reconstruction.records import Specularities, Specularity
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Image
from simtest.runtime.seeds import from_integer
from simtest.simulation.frame import RenderedView, render_view
from simtest.spec import Scene, load_scene
from simtest.validation.statistics import is_wrong_and_sure
from studies.one_light import OneLight, in_8_bits, rendered, told

Row = dict[str, Any]

ROOT = Path(__file__).parents[1]
TRAINED = ("albedo", "convex", "creases", "fold_edges")
TESTED = {"broad_lobe": 420, "outlines": 420, "concave": 180}
"""The kinds that the score was not fitted to, with how many false detections of each are looked at."""

SLOW = ("inter_reflection",)
"""Not in the table: its false detections are too rare for the time that its frames take."""
SEED, TRAINED_SEED = 700, 601
MOST_FRAMES = 800  # of a kind
SIZE, FOV_DEG = (400, 300), 30.0
BODIES, PER_BODY = 20, 24  # bodies of a seed, and frames of each before the next
BLOBS, CELLS = 36, 90  # of a body, and along it
MOST_OF_FRAME = 10  # detections of either truth that a frame gives
COLOURED, GLOSSY = 0.4, {"convex": 0.25, "concave": 0.25, "albedo": 0.35}  # share of the frames; else half are glossy
BROAD = ("broad_lobe", "outlines")
FITTED, FIT_COUNT, FEW, RIDGE = {"albedo": 96, "convex": 140}, 150, 40, 0.02  # frames, and as `fit` takes them
CLEAR = {"smooth": 120, "tissue": 12}  # frames
THRESHOLDS = (0.3, LEAST_SCORE, 0.7, 0.8, 0.9)
RESOLVED_PX = 2.0  # what a pixel resolves: the normals' mean with a Gaussian of this standard deviation


class Detected(NamedTuple):
    """A detection with its truth, and with error and ± of the best answer, deg; NaN where there is none."""

    kind: str
    spot: Specularity
    frame: Frame
    true: bool
    error: float
    stated: float

    @property
    def is_answered(self) -> bool:
        """Whether there is an answer, whatever the score."""
        return not math.isnan(self.error)

    @property
    def is_wrong_and_sure(self) -> bool:
        """Whether the answer is off by more than 5 deg and by more than three times its ±; not without an answer."""
        return bool(is_wrong_and_sure(self.error, self.stated))


# Scenes ---------------------------------------------------------------------------------------------------------------


@cache
def meshes() -> Path:
    """Return a folder for the bodies of this process."""
    return Path(tempfile.mkdtemp(prefix="foolers"))


@cache
def body(number: int, form: str) -> str:
    """Make the mesh of a body of about 50 mm, and return its path.

    "blobs" run into each other; "cut" ones have edges; of "dented" ones the blobs are hollows of a ball.
    """
    random = from_integer({"blobs": 7000 + 2 * number, "cut": 7001 + 2 * number, "dented": 9000 + number}[form])
    x = np.stack(np.meshgrid(*3 * [np.linspace(-1.4, 1.4, CELLS + 1)], indexing="ij"), axis=-1)
    centres, sizes = random.uniform(-0.8, 0.8, (BLOBS, 3)), random.uniform(0.08, 0.4, BLOBS)
    if form == "dented":
        centres *= random.uniform(0.85, 1.1, (BLOBS, 1)) / np.linalg.norm(centres, axis=-1, keepdims=True)
    blobs = [size - np.linalg.norm(x - centre, axis=-1) for centre, size in zip(centres, sizes, strict=True)]
    height = np.log(sum(np.exp(blob / 0.05) for blob in blobs)) * 0.05
    if form == "dented":
        height = np.minimum(1.0 - np.linalg.norm(x, axis=-1), -height)
    for _ in range(8 if form == "cut" else 0):
        across = random.normal(size=3)
        height = np.minimum(height, random.uniform(0.45, 0.75) - x @ across / np.linalg.norm(across))
    height = np.where(np.abs(x).max(axis=-1) > 1.35, -1.0, height)
    return surface_of(height, 70 / CELLS, f"{form}{number}", outwards=True)


@cache
def tube(number: int) -> str:
    """Make the mesh of a tube of about 40 mm across with thin folds, seen from inside, and return its path."""
    random = from_integer(8000 + number)
    across, along = np.linspace(-24, 24, 81), np.linspace(-60, 60, 201)
    x, y, z = np.meshgrid(across, across, along, indexing="ij")
    around, radius = np.arctan2(y, x), 20.0 + np.zeros_like(z)
    for place in np.arange(-50, 51, random.uniform(10, 18)):
        depth = random.uniform(3, 10) * (0.55 + 0.45 * np.cos(random.integers(1, 4) * around + random.uniform(0, 6)))
        lean = place + random.uniform(-3, 3) + random.uniform(0, 4) * np.cos(around + random.uniform(0, 6))
        radius -= depth * np.exp(-(((z - lean) / random.uniform(1.0, 3.0)) ** 2) / 2)
    height = np.where(np.abs(z) > 58, -1.0, np.maximum(radius, 5) - np.hypot(x, y))
    return surface_of(height, 0.6, f"tube{number}", outwards=False)


def surface_of(height: Array, cell_mm: float, name: str, outwards: bool) -> str:
    """Write the mesh of where a height is 0, with normals to where it is negative or not, and return its path."""
    vertices, faces, _, _ = marching_cubes(height, 0.0)
    path = meshes() / f"{name}.obj"
    lines = ["v {} {} {}".format(*row) for row in ((vertices - vertices.mean(axis=0)) * cell_mm).round(4)]
    lines += ["f {} {} {}".format(*row) for row in (faces[:, ::-1] if outwards else faces) + 1]
    path.write_text("\n".join(lines), encoding="ascii")
    return str(path)


def drawn(kind: str, number: int, seed: int) -> Scene:
    """Draw a scene of a kind; what has to be compiled stays the same for `PER_BODY` numbers."""
    random, block = from_integer(10000 * seed + number), number // PER_BODY
    mesh = block % BODIES + BODIES * (seed % 50)
    in_tube, hollow = kind == "fold_edges", kind in ("concave", "inter_reflection")
    # lens and light
    focal = SIZE[0] / 2 / math.tan(math.radians(90.0 if in_tube else FOV_DEG) / 2)
    values: Row = {"camera.width": SIZE[0], "camera.height": SIZE[1], "camera.fx": focal, "camera.fy": focal}
    around, reach = random.uniform(0, 2 * math.pi), random.uniform(0.1, 8.0 if in_tube else 300.0)
    behind = 0.0 if in_tube else random.uniform(0.1, 0.4) if kind == "outlines" else random.uniform(-0.3, 0.3)
    position = reach * np.array([math.cos(around), math.sin(around), behind]) * (number % 4 > 0)
    values["rig.lights"] = [{"position_mm": position.tolist()}]
    # form
    if in_tube:
        form: Row = {"type": "anatomy", "path": tube(mesh), "kind": "lumen", "subdivisions": 0, "viewpoint": number}
        form |= {"view": "auto"}
    elif kind == "albedo" and block % 2:
        distance = random.uniform(40, 200)
        form = {"type": "quadric", "distance_mm": distance, "tilt_deg": random.uniform(0, 40)}
        form |= {key: random.uniform(-1, 5) / distance for key in ("k1_per_mm", "k2_per_mm")}
    else:
        path = body(mesh, "dented" if hollow else "cut" if kind == "creases" and block % 2 == 0 else "blobs")
        form = {"type": "anatomy", "path": path, "kind": "organ", "subdivisions": 0, "viewpoint": number}
    if kind == "creases" and block % 2:
        band = {"kind": "ridged", "slope_deg": random.uniform(2, 8), "wavelength_mm": random.uniform(0.05, 0.4)}
        form["relief"] = {"bands": [band], "seed": number, "diffusion_mm": 0.0}
    values |= {f"surface.{key}": each for key, each in form.items()}
    values |= {f"reflectance.{key}": each for key, each in _skin(kind, random, block).items()}
    # every fourth block has the scene's own mottling and vessels, whose pattern is slow to make; all are painted
    file = "convex" if kind == "albedo" and block % 4 else kind
    return load_scene(ROOT / "scenes" / "foolers" / f"{file}.toml", values)


def _skin(kind: str, random: np.random.Generator, block: int) -> Row:
    """Draw a reflectance of a kind, with a narrow lobe in the frames that are `GLOSSY`."""
    lobe = {"type": "phong", "exponent": 10 ** random.uniform(1.6, 3.0), "specular": 10 ** random.uniform(-0.3, 0.8)}
    has_own_colour = kind == "albedo" and block % 4 == 0
    base: Row = {} if has_own_colour else {"diffuse": random.uniform(0.2, 0.7)}
    if not has_own_colour and random.random() < COLOURED:
        base["colour"] = [random.uniform(0.6, 1.0), random.uniform(0.3, 0.8), random.uniform(0.2, 0.7)]
    # of broad lobes a third of the blocks is glossy throughout: another type is another kernel
    glossy = block % 3 == 2 if kind in BROAD else random.random() < GLOSSY.get(kind, 0.5)
    if kind == "inter_reflection":
        return base | {"exponent": lobe["exponent"] if glossy else 10 ** random.uniform(1.3, 2.1), "specular": 0.25}
    if glossy or kind == "creases":
        return base | lobe
    if kind in BROAD:
        alpha = random.uniform(0.2, 0.6)
        broad = (
            {"type": "rough_plastic", "alpha": alpha},
            {"type": "phong", "exponent": 2 / alpha**2, "specular": random.uniform(0.05, 0.5)},
            {"type": "principled", "roughness": math.sqrt(alpha)},
        )
        return base | broad[block // 3 % 3 if block % 3 else 0]
    return base | {"specular": 0.0 if kind != "fold_edges" else random.uniform(0.0, 0.1)}


# Pictures -------------------------------------------------------------------------------------------------------------


def paint(random: np.random.Generator) -> Image:
    """Return an albedo that is painted on: soft or hard patches, dark ones or pale."""
    height, width = SIZE[::-1]
    pattern = cv2.GaussianBlur(random.normal(size=(height, width)), (0, 0), 10 ** random.uniform(0.5, 1.3))
    pattern /= pattern.std()
    hard = random.random() < 0.5
    shown = np.tanh(8 * (pattern - random.uniform(0, 1.5))) if hard else pattern
    return np.exp(random.uniform(0.2, 0.7) * shown).astype(np.float32)


def photograph(light: Image, random: np.random.Generator, sharpened: float) -> Image:
    """Return a picture of 8 bits, sRGB: exposed for highlights or for the base, blurred, with noise, sharpened."""
    quantile, over = (0.9995, random.uniform(0.8, 1.6)) if random.random() < 0.5 else (0.98, random.uniform(1.0, 2.5))
    scale = max(float(np.quantile(light, quantile)) * over, 1e-12)
    linear = cv2.GaussianBlur(light / scale, (0, 0), random.uniform(0.5, 1.0))
    linear = np.clip(linear + random.normal(0, 0.004, light.shape), 0, 1)
    encoded = srgb_encode(linear)
    if random.random() < sharpened:
        encoded += random.uniform(0.3, 1.2) * (encoded - cv2.GaussianBlur(encoded, (0, 0), random.uniform(0.7, 1.5)))
    return np.asarray(np.rint(255 * np.clip(encoded, 0, 1)), dtype=np.uint8)


def quiet(indirect: Image) -> Image:
    """Return light of more than one bounce without the noise of its few samples: it is broad."""
    return np.asarray(cv2.GaussianBlur(cv2.medianBlur(indirect, 5), (0, 0), 2.0)) if indirect.any() else indirect


def detections(kind: str, number: int, seed: int, session: Session | None) -> tuple[Session | None, list[Detected]]:
    """Render a frame of a kind, and return its detections with their truth, and the session."""
    random = from_integer(10000 * seed + number + 5000)
    scene = drawn(kind, number, seed)
    try:
        session = session or Session(scene, "llvm_ad_rgb")
        session.update(scene)
        radiance = session.radiance()
    except SimtestError as error:
        print(f"{kind} {number}: {error}", file=sys.stderr)
        return session, []
    base = radiance.diffuse * (paint(random)[..., None] if kind == "albedo" else 1)
    light = base + radiance.specular + quiet(radiance.indirect)
    grey = not scene.is_coloured or (kind == "albedo" and number % 2 == 0)
    shown = photograph(mean_channel(light) if grey else light, random, 0.75 if kind == "outlines" else 0.25)
    # what a user gives
    depths = session.depths()
    if not np.isfinite(depths).any():
        return session, []
    middle = float(np.nanmedian(depths))
    distance = Normal(middle, 0.1 * middle)
    priors = Priors((scene.rig.lights[0].nominal_mm,), distance, falloff_power=None, floors=OF_PICTURES)
    calibration = Calibration(scene.camera.model(), priors=priors)
    detector = "peaks" if grey or number % 4 == 1 else "colour"
    found = reconstruct(shown, calibration, ["bisector"], detector=detector, least_score=0)
    # truth
    lobe, normals = mean_channel(radiance.specular), None
    if kind in ("creases", "fold_edges"):
        lobe, normals = resolved(session, lobe)
    made = []
    for spot in found:
        if isinstance(spot.patch, Patch):
            truth = is_highlight(spot.patch, mean_channel(light), lobe)
            made.append(Detected(kind, spot, found.detection.frame, truth, *scored(spot, session, normals)))
    return session, made


def is_highlight(patch: Patch, light: Image, lobe: Image) -> bool:
    """Whether the lobe makes at least half of the noise-free light's rise from around a detection to its peak."""
    (x, y), (height, width) = patch.origin_px, patch.values.shape
    around = np.s_[max(y - 1, 0) : y + height + 1, max(x - 1, 0) : x + width + 1]
    light, lobe = (smooth(each, patch.smoothing_px)[around] for each in (light, lobe))
    inside = np.zeros(light.shape, dtype=bool)
    down, right = min(y, 1), min(x, 1)
    inside[down : down + height, right : right + width] = patch.inside(0.5, cut=True)
    ring = dilated(inside) & ~inside
    peak = np.unravel_index(np.where(inside, light, -np.inf).argmax(), light.shape)
    rise, of_lobe = (float(each[peak] - np.median(each[ring])) if ring.any() else 0.0 for each in (light, lobe))
    return of_lobe > 0 and of_lobe >= 0.5 * rise


def resolved(session: Session, lobe: Image) -> tuple[Image, Array]:
    """Return a Phong lobe's light on the surface that a pixel resolves, and that surface's normals."""
    labels, scene = session.frame().labels, session.scene
    valid = np.isfinite(labels.depth)
    fine = np.where(valid[..., None], labels.normal, 0.0).astype(np.float32)
    normals: Array = unit(cv2.GaussianBlur(fine, (0, 0), RESOLVED_PX) + np.array([0, 0, -1e-9]))
    to_light = np.array(scene.rig.lights[0].nominal_mm) - labels.position
    range2 = (to_light**2).sum(axis=-1)
    exponent = getattr(scene.reflectance, "exponent", 1.0)

    def cosine_power(each: Image | Array) -> Array:
        to, back = unit(to_light), unit(-labels.position)
        mirrored = 2 * (to * each).sum(axis=-1, keepdims=True) * each - to
        return np.asarray(np.clip((mirrored * back).sum(axis=-1), 0, 1) ** exponent / range2)

    shown = cosine_power(labels.normal)
    strong = valid & (shown > 0.3 * np.nanmax(np.where(valid, shown, 0)))
    scale = float(np.median(lobe[strong] / shown[strong])) if strong.any() else 0.0
    return np.where(valid, scale * cosine_power(normals), 0.0).astype(np.float32), normals


def scored(spot: Specularity, session: Session, normals: Array | None) -> tuple[float, float]:
    """Return error and ± of the best answer, deg, against given normals or the surface's own; NaN without an answer."""
    best = spot.best_estimate
    if best is None or best.cloud is not None:
        return math.nan, math.nan
    if normals is not None:
        column, row = (int(min(max(at, 0), size - 1)) for at, size in zip(best.look_px, SIZE, strict=True))
        return float(angle_deg(best.normal, normals[row, column])), best.deviation_deg or 0.0
    at_look = session.exact_points(best.look_px[None])
    error = float(angle_deg(best.normal, at_look.normal[0])) if at_look.valid[0] else 90.0
    return error, best.deviation_deg or 0.0


def of_kind(kind: str, count: int, seed: int, frames: int) -> list[Detected]:
    """Return `count` false detections of a kind and as many true ones, those that come first."""
    kept: dict[bool, list[Detected]] = {False: [], True: []}
    session: Session | None = None
    for number in range(frames):
        session, made = detections(kind, number, seed, session)
        for truth in kept:
            kept[truth] += [each for each in made if each.true == truth][:MOST_OF_FRAME]
        if min(map(len, kept.values())) >= count:
            break
    print(f"{kind}: {number + 1} frames, {len(kept[True])} true, {len(kept[False])} false", file=sys.stderr)
    return kept[False][:count] + kept[True][:count]


def of_smooth(frames: int, seed: int) -> list[Detected]:
    """Return the highlights of smooth colons and livers, grey frames with the light 2 mm aside or at the camera."""
    made: list[Detected] = []
    session: Session | None = None
    for number in range(frames):
        organ = "colon" if number < frames // 2 else "liver"
        values: Row = {"surface.path": organ, "surface.viewpoint": 1000 * (seed % 900) + number, "sensor.seed": number}
        light = {"offset_mm": 2.0 * (number % 2), "azimuth_deg": 45.0}
        scene = load_scene("anatomy", values | {"rig.lights": [light]})
        session = session or Session(scene)
        view = render_view(session, scene)
        found = reconstruct(view.frame(seed + number), view.calibration, ["bisector"], least_score=0)
        made += of_view("smooth", session, view, found)
    return made


def of_tissue(frames: int, seed: int) -> list[Detected]:
    """Return the highlights of frames of the recipe `endoscopy_close`, as `studies.one_light` draws and tells them."""
    plan, made = OneLight(seed, frames), list[Detected]()
    for number in range(frames):
        drawn_frame = rendered(plan, number)
        if drawn_frame is not None:
            session, view, family = drawn_frame
            found = run(in_8_bits(view), told(view, family), Options(estimators=("bisector",), least_score=0))
            made += of_view("tissue", session, view, found)
    return made


def of_view(kind: str, session: Session, view: RenderedView, found: Specularities) -> list[Detected]:
    """Return the answered highlights of a rendered view; glints and near misses are true ones."""
    made = []
    for each in score(session, view, found):
        spot, estimate = found[each.spot.index], each.spot.estimate
        if isinstance(spot.patch, Patch):
            stated = estimate.deviation_deg or 0.0
            made.append(Detected(kind, spot, found.detection.frame, each.kind != "false", each.error_deg, stated))
    return made


# Score ----------------------------------------------------------------------------------------------------------------


def score_of(each: Detected) -> float:
    """Return the score of a detection; 1 where it has none, as an answer without a score is not refused."""
    spot = each.spot
    if isinstance(spot.patch, Failure):
        return 1.0
    found = highlight_scores([spot.patch], each.frame)[0]
    return 1.0 if found is None else found


def auc(scores: Array, true: Array) -> float:
    """Return the chance that a true detection scores higher than a false one."""
    if true.all() or not true.any():
        return math.nan
    ranks = rankdata(scores)
    count = int(true.sum())
    return float((ranks[true].sum() - count * (count + 1) / 2) / (count * (len(true) - count)))


def fit(detected: Sequence[Detected]) -> Array:
    """Return the score's bias and weights by logistic regression; the true and the false of each kind count alike."""
    seen = [
        (each, features([each.spot.patch], each.frame)[0]) for each in detected if isinstance(each.spot.patch, Patch)
    ]
    rows = [(each, found) for each, found in seen if found is not None]
    x, true = np.array([found for _, found in rows]), np.array([each.true for each, _ in rows])
    groups = [(each.kind, each.true) for each, _ in rows]
    weight = np.array([1 / max(groups.count(group), FEW) for group in groups])
    scale = x.std(axis=0)
    x = np.column_stack([np.ones(len(x)), x / scale])

    def loss(beta: Array) -> float:
        odds = np.where(true, 1, -1) * (x @ beta)
        return float(weight @ np.logaddexp(0, -odds)) + RIDGE * float(beta[1:] @ beta[1:])

    found: Array = minimize(loss, np.zeros(x.shape[1])).x
    return np.asarray(found / np.concatenate([[1.0], scale]))


def row_of(each: Detected) -> Row:
    """Return what the tables need of a detection."""
    numbers = {"true": each.true, "error": each.error, "stated": each.stated, "score": score_of(each)}
    return {"kind": each.kind, "wrong_and_sure": each.is_wrong_and_sure, "answered": each.is_answered, **numbers}


def summary(name: str, rows: Sequence[Row], least: float = LEAST_SCORE) -> list[str]:
    """Describe a group of detections without the score and with a threshold."""
    scores, true = (np.array([row[key] for row in rows]) for key in ("score", "true"))
    line = [name, str(int(true.sum())), str(int((~true).sum())), f"{auc(scores, true):.3f}"]
    passed = scores >= least
    for kept in (np.ones(len(rows), dtype=bool), passed):
        answers = [row for row, own in zip(rows, kept, strict=True) if own and row["answered"]]
        line += [str(len(answers)), _share(sum(row["wrong_and_sure"] for row in answers), len(answers))]
    line.append(_share(int((true & ~passed).sum()), int(true.sum())))
    return [*line, _share(int((passed & ~true).sum()), int((~true).sum()))]


def _share(part: int, whole: int) -> str:
    return f"{part} ({100 * part / whole:.1f} %)" if whole else "-"


def real(folder: Path) -> int:
    """Print what share of the detections of coloured pictures in a folder would be refused."""
    rows = [["picture", "detections", "refused"]]
    for path in sorted(each for each in folder.rglob("*") if each.suffix in (".png", ".jpg", ".bmp")):
        if path.name in ("depth.png", "normals.png"):
            continue
        found = reconstruct(path, 100.0, ["brightest_point"], detector="colour")
        spots = [spot for spot in found if isinstance(spot.patch, Patch)]
        scores = [score_of(Detected("real", spot, found.detection.frame, True, 0.0, 0.0)) for spot in spots]
        refused = sum(value < LEAST_SCORE for value in scores)
        rows.append([path.name, str(len(spots)), _share(refused, len(spots))])
        print(rows[-1], file=sys.stderr, flush=True)
    counts = [sum(int(row[column].split()[0]) for row in rows[1:] if row[column] != "-") for column in (1, 2)]
    print_markdown([*rows, ["all", str(counts[0]), _share(counts[1], counts[0])]])
    return 0


def main(arguments: Sequence[str]) -> int:
    """Print the table, the fit or what is refused of real pictures."""
    if arguments and arguments[0] == "--real":
        return real(Path(arguments[1]))
    if arguments and arguments[0] == "--fit":
        detected = [each for kind, frames in FITTED.items() for each in of_kind(kind, FIT_COUNT, TRAINED_SEED, frames)]
        detected += of_smooth(40, TRAINED_SEED) + of_tissue(10, TRAINED_SEED)
        print(", ".join(f"{name} {value:.2f}" for name, value in zip(("bias", *NAMES), fit(detected), strict=True)))
        return 0
    share = float(arguments[0]) if arguments else 1.0
    seed = int(arguments[1]) if len(arguments) > 1 else SEED
    made: dict[str, list[Row]] = {}
    for kind in (*TESTED, "smooth", "tissue"):
        if kind in TESTED:
            found = of_kind(kind, round(share * TESTED[kind]), seed, MOST_FRAMES)
        else:
            found = (of_smooth if kind == "smooth" else of_tissue)(round(share * CLEAR[kind]), seed)
        made[kind] = [row_of(each) for each in found]
        if len(arguments) > 2:
            Path(arguments[2]).write_text(json.dumps(made), encoding="ascii")
    report(made)
    return 0


def report(made: dict[str, list[Row]]) -> None:
    """Print the table of each kind, and that of other thresholds."""
    foolers = [row for kind in TESTED for row in made[kind]]
    heads = ["answered, no score", "wrong and sure", "answered", "wrong and sure", "true ones refused"]
    lines = [summary(name, made.get(name, foolers)) for name in (*TESTED, "all three", "smooth", "tissue")]
    print_markdown([["kind", "true", "false", "AUC", *heads, "false ones kept"], *lines])
    table = [["least score", *heads[2:], "false ones kept", "true ones refused, smooth", "true ones refused, tissue"]]
    for least in THRESHOLDS:
        clear = [summary(name, made[name], least)[8] for name in CLEAR]
        table.append([f"{least:g}", *summary("", foolers, least)[6:], *clear])
    print_markdown(table)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
