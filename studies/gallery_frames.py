"""Draw the gallery's sheets of frames: surfaces, anatomies, tissue, camera chains; rigs, a lens and an instrument.

python -m studies.gallery_frames FOLDER [SHEET]...

Each sheet is a JPEG of two columns, FOLDER/SHEET.jpg. docs/gallery/index.md shows them.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

TILE = (512, 384)
QUALITY = 85
LIT: dict[str, object] = {
    "reflectance.specular": 0.2, "reflectance.diffuse": 0.8, "reflectance.colour": [0.85, 0.45, 0.40],
    "camera.width": 512, "camera.height": 384, "sensor.noise_sigma": 0.01,
}  # fmt: skip
"""A lobe over a base that shows the surface's form, with little noise."""

GLOSSY = LIT | {"reflectance.specular": 1.0, "reflectance.diffuse": 0.5}

Crop = tuple[int, int, int, int]

CHAIN_CROP: Crop = (370, 330, 192, 144)
"""Column, row, width and height of the part that shows what a camera chain does to highlights, px."""

Tile = tuple[str, str, dict[str, object]]
"""Caption, scene, and the values that replace the scene's."""

ORGAN: dict[str, object] = {"sensor.exposure": "{average = 0.3}", "sensor.saturation": True, "sensor.noise_sigma": 0.01}

POLYPS = "{polyps = [{along_mm = 60, around_deg = 90, height_mm = 7, width_mm = 6, neck_mm = 3}]}"

SHEETS: dict[str, tuple[Tile, ...]] = {
    "surfaces": tuple((name, name, LIT) for name in ("plane", "cylinder", "sphere", "saddle")),
    "anatomies": (
        ("colon, along its path", "anatomy", {**ORGAN, "surface.view": "path", "surface.path_share": 0.3}),
        ("colon, facing the wall", "anatomy", {**ORGAN, "surface.view": "wall", "surface.path_share": 0.5}),
        ("colon with a pedunculated polyp", "anatomy",
         {**ORGAN, "surface.view": "path", "surface.path_share": 0.35, "surface.recipe": POLYPS}),
        ("liver", "anatomy", {**ORGAN, "surface.path": "liver", "camera.fx": 480, "camera.fy": 480}),
    ),
    "tissue": tuple((name, f"tissue_{name}", {}) for name in ("colon", "liver", "stomach", "gallbladder")),
    "camera_chains": (
        ("no camera chain", "tissue_colon", {}),
        *((name, "tissue_colon", {"sensor": f'{{preset = "{name}"}}'}) for name in (
            "colonoscope_hd", "laparoscope_hd", "old_sd",
        )),
    ),
    "rigs": (
        ("laparoscope: a ring of eight lights", "sphere",
         {**GLOSSY, "rig.preset": "laparoscope", "surface.distance_mm": 30, "surface.radius_mm": 15,
          "reflectance.exponent": 800}),
        ("colonoscope: two lights", "cylinder",
         {**GLOSSY, "rig.preset": "colonoscope_2", "surface.distance_mm": 30, "surface.radius_mm": 15,
          "reflectance.exponent": 400}),
        ("fisheye with cut corners, inside a colon", "anatomy",
         {"camera.fx": 170, "camera.fy": 170, "camera.width": 512, "camera.height": 384,
          "camera.distortion": '{type = "kannala_brandt"}',
          "camera.view_mask": "{radius = 230, half_height = 180, corner = 60}",
          "sensor.exposure": "{average = 0.3}", "sensor.saturation": True}),
        ("a grasper before a liver", "tissue_liver",
         {"instruments": '[{kind = "grasper", tip = [0.55, 0.6]}]', "sensor.exposure": "{average = 0.3}"}),
    ),
}  # fmt: skip


def tile(caption: str, scene: str, values: dict[str, object], folder: Path, crop: Crop | None) -> np.ndarray:
    """Render a scene in colour and return the frame, or a part of it, at the size of a tile, with its caption."""
    settings = [part for key, value in values.items() for part in ("--set", f"{key}={_text(value)}")]
    command = [sys.executable, "-m", "simtest", "render", scene, "--variant", "llvm_ad_rgb", "--out", str(folder)]
    subprocess.run([*command, *settings], check=True, stdout=subprocess.DEVNULL)
    frame = cv2.imread(str(folder / "frame.png"), cv2.IMREAD_COLOR)
    if crop is not None:
        x, y, wide, high = crop
        frame = frame[y : y + high, x : x + wide]
    scaled = cv2.resize(frame, TILE, interpolation=cv2.INTER_AREA if crop is None else cv2.INTER_NEAREST)
    (width, height), _ = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    cv2.rectangle(scaled, (0, TILE[1] - height - 14), (width + 14, TILE[1]), (0, 0, 0), cv2.FILLED)
    cv2.putText(scaled, caption, (7, TILE[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return scaled


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def draw(name: str, folder: Path) -> None:
    """Render the tiles of a sheet and write it."""
    with tempfile.TemporaryDirectory() as work:
        crop = CHAIN_CROP if name == "camera_chains" else None
        tiles = [tile(*each, Path(work) / str(i), crop) for i, each in enumerate(SHEETS[name])]
    rows = np.vstack([np.hstack(tiles[i : i + 2]) for i in range(0, len(tiles), 2)])
    cv2.imwrite(str(folder / f"{name}.jpg"), rows, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    for sheet in sys.argv[2:] or SHEETS:
        draw(sheet, Path(sys.argv[1]))
