"""Reconstruct normals in a picture: a frame of yours, or one that looks like it.

    python examples/07_picture_of_a_real_frame.py my_frame.png

takes a PNG, JPEG, BMP or TIFF; FOV_DEG below must then be its camera's horizontal field of view. Without a picture, the
example renders colon mucosa through the camera chain of an endoscope: mosaic, sharpening, JPEG. The reconstruction is
told the field of view alone; what it does not know widens the uncertainties that it states.

Picture: the frame with a needle at each isolated highlight. Wide bright patches are several highlights that touch: they
carry no single normal and get none. Takes 9 s of processor time.
"""

import sys
from collections import Counter

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, options, save
from PIL import Image

import simtest

FOV_DEG = 90.0
NEEDLE = 0.12  # length of a normal that lies in the picture's plane, as a share of the picture's width

chosen = options(__doc__, "picture")
if chosen.picture is None:
    size = (320, 240) if chosen.quick else (640, 480)
    camera = {"camera.width": size[0], "camera.height": size[1], "camera.fx": size[0] / 2, "camera.fy": size[0] / 2}
    chain = {"sensor.preset": "colonoscope_hd", "sensor.coding": {"type": "jpeg", "quality": 90}}
    frame = simtest.render("tissue_colon", camera | chain | {"render.samples_per_pixel": 4})
    chosen.picture = chosen.out / "07_rendered.png"
    Image.fromarray(np.round(255 * frame.image).astype(np.uint8)).save(chosen.picture)

# 8-bit values are taken as sRGB, clipped at 255; a simtest.Calibration in place of the number tells more.
picture = np.asarray(Image.open(chosen.picture).convert("RGB"))
spots = simtest.reconstruct(picture, FOV_DEG)
assumed = "; ".join(str(each) for each in spots.choices.assumed)
print(f"{len(spots)} isolated highlights; assumed: {assumed}")

results = [spot.estimates["cone_axis"] for spot in spots]
answers = [each for each in results if not isinstance(each, simtest.Failure)]
outcomes = dict(Counter(str(each.reason) if isinstance(each, simtest.Failure) else "ok" for each in results))
if not answers:
    sys.exit(f"{chosen.picture}: no highlight with a normal: {outcomes or 'none found'}")
print(outcomes)
sigmas = [np.degrees(np.sqrt(np.trace(each.covariance))) for each in answers if each.covariance is not None]

figure, axis = plt.subplots(figsize=(7.4, 5.2), layout="constrained")
axis.imshow(picture)
x, y = np.transpose([each.look_px for each in answers])
u, v = np.transpose([each.normal[:2] * NEEDLE * picture.shape[1] for each in answers])
axis.quiver(x, y, u, v, angles="xy", scale_units="xy", scale=1, color=COLOURS["curved"], width=0.006,
            edgecolor="black", linewidth=0.5, label="normal, as seen in the picture")  # fmt: skip
axis.plot(x, y, "o", color="black", markersize=3)
axis.set(xlabel="x, px", ylabel="y, px")
axis.set_title(f"{len(x)} normals of cone_axis; stated standard deviation {np.median(sigmas):.1f} deg (median)")
axis.legend(loc="upper left")
save(figure, chosen.out / "07_picture_of_a_real_frame.jpg")
