"""Good files, which cases spoil, and things that are no plain files."""

import io
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io

Content = bytes | str | Callable[[Path], None]
"""Of a file: bytes, text, or a function that makes what stands at a path."""

WIDTH, HEIGHT = 64, 48

SCENE = f"""[surface]
type = "plane"
distance_mm = 10.0
[reflectance]
type = "phong"
exponent = 50.0
[camera]
width = {WIDTH}
height = {HEIGHT}
fx = 48.0
fy = 48.0
"""
EXPERIMENT = """realisations = 1
[[groups]]
scene = "plane"
set = { "camera.width" = 64, "camera.height" = 48, "camera.fx" = 48.0, "camera.fy" = 48.0 }
sweep = [{ "surface.tilt_deg" = [5] }]
"""
DATASET = """samples = 2
splits = { train = 1, validation = 0, test = 0 }
[[families]]
scene = "plane"
set = { "camera.width" = 64, "camera.height" = 48, "camera.fx" = 48.0, "camera.fy" = 48.0 }
[per_sample]
"surface.tilt_deg" = { low = 0.0, high = 20.0 }
"""
PROFILE = """[[experiments]]
experiment = "overview"
realisations = 1
labels = ["plane"]
"""
COLON = 'type = "colon"\nlength_mm = 60\n'
LIVER = 'type = "liver"\n'
CAMERA = f"width = {WIDTH}\nheight = {HEIGHT}\nfx = 60.0\nfy = 60.0\n"
CALIBRATION = f'[camera]\n{CAMERA}[response]\ntype = "gamma"\ngamma = 2.2\n[sensor]\nnoise_sigma = 0.01\n'
POSE = "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation_mm = [0, 0, 40]\n"

OPENCV_YAML = f"""%YAML:1.0
---
image_width: {WIDTH}
image_height: {HEIGHT}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 60., 0., 31.5, 0., 60., 23.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.1, 0.01, 0., 0., 0. ]
"""
OPENCV_XML = f"""<?xml version="1.0"?>
<opencv_storage>
<image_width>{WIDTH}</image_width>
<image_height>{HEIGHT}</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>60. 0. 31.5 0. 60. 23.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows>
  <cols>5</cols>
  <dt>d</dt>
  <data>-0.1 0.01 0. 0. 0.</data></distortion_coefficients>
</opencv_storage>
"""
OPENCV_JSON = json.dumps(
    {
        "image_width": WIDTH,
        "image_height": HEIGHT,
        "camera_matrix": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d",
                          "data": [60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]},
        "distortion_coefficients": {"type_id": "opencv-matrix", "rows": 1, "cols": 5, "dt": "d",
                                    "data": [-0.1, 0.01, 0, 0, 0]},
    }
)  # fmt: skip
ROS_YAML = f"""image_width: {WIDTH}
image_height: {HEIGHT}
camera_name: scope
camera_matrix:
  rows: 3
  cols: 3
  data: [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.01, 0.0, 0.0, 0.0]
"""


def picture(width: int = WIDTH, height: int = HEIGHT) -> Any:
    """Return a picture of a highlight, of 8 bits, shape (H, W, 3)."""
    rows, columns = np.mgrid[:height, :width]
    spot = np.exp(-((columns - width / 2) ** 2 + (rows - height / 2) ** 2) / (width * height / 60))
    return ([60, 70, 110] + 190 * spot[..., None]).clip(0, 255).astype(np.uint8)


def encoded(suffix: str, values: Any = None) -> bytes:
    """Return a picture's file by its suffix, such as ".png"."""
    done, data = cv2.imencode(suffix, picture() if values is None else values)
    assert done
    return data.tobytes()


def png(width: int, height: int, data: bytes | None = None) -> bytes:
    """Return a black grey PNG of any size; small, since black compresses."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    if data is None:
        squeezer = zlib.compressobj(1)
        parts = [squeezer.compress(bytes(width + 1)) for _ in range(height)]
        data = b"".join(parts) + squeezer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def animated(kind: str, frames: int = 3, sizes: bool = False) -> bytes:
    """Return an animated picture (GIF, PNG, WebP) or a TIFF of several pages; of different sizes on request."""
    from PIL import Image

    step = 8 if sizes else 0
    made = [Image.fromarray(np.roll(picture(WIDTH + step * i, HEIGHT), 5 * i, axis=1)) for i in range(frames)]
    file = io.BytesIO()
    made[0].save(file, kind, save_all=True, append_images=made[1:])
    return file.getvalue()


def npy(values: Any, **options: Any) -> bytes:
    """Return an NPY file."""
    file = io.BytesIO()
    np.save(file, values, **options)
    return file.getvalue()


def depth(value: float = 30.0) -> Any:
    """Return a depth map, mm: a slanted plane."""
    return (value + np.mgrid[:HEIGHT, :WIDTH][1] / 10).astype(np.float32)


def exr(values: Any) -> bytes:
    """Return an EXR file of one channel, Z, of 32 bits, without compression."""
    height, width = values.shape

    def attribute(name: str, kind: str, content: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(content)) + content

    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = b"Z\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) + b"\0"
    header = struct.pack("<ii", 20000630, 2)
    header += attribute("channels", "chlist", channels) + attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", box) + attribute("displayWindow", "box2i", box)
    header += attribute("lineOrder", "lineOrder", b"\0") + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", bytes(8))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    lines = [struct.pack("<ii", y, 4 * width) + values[y].astype("<f4").tobytes() for y in range(height)]
    first = len(header) + 8 * height
    offsets = struct.pack(f"<{height}Q", *(first + y * len(lines[0]) for y in range(height)))
    return header + offsets + b"".join(lines)


def matlab(**fields: Any) -> bytes:
    """Return a calibration as MATLAB saves it, with fields replaced; None leaves one out."""
    table: dict[str, Any] = {
        "K": [[60.0, 0, 32.0], [0, 60.0, 24.0], [0, 0, 1]], "ImageSize": [HEIGHT, WIDTH],
        "RadialDistortion": [-0.1, 0.01], "TangentialDistortion": [0.0, 0.0],
    }  # fmt: skip
    table = {name: value for name, value in {**table, **fields}.items() if value is not None}
    file = io.BytesIO()
    scipy.io.savemat(file, {"s": table})
    return file.getvalue()


CORNERS = ((0, 0, 0), (40, 0, 0), (0, 40, 0), (0, 0, 40))
SIDES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def ply(corners: Any = CORNERS, sides: Any = SIDES) -> str:
    """Return a mesh as a PLY file of text: a tetrahedron."""
    header = ["ply", "format ascii 1.0", f"element vertex {len(corners)}", *(f"property float {c}" for c in "xyz")]
    header += [f"element face {len(sides)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(map(str, corner)) for corner in corners]
    return "\n".join([*header, *body, *(f"{len(side)} {' '.join(map(str, side))}" for side in sides)]) + "\n"


def obj() -> str:
    """Return the same as an OBJ file."""
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in SIDES]
    return "\n".join(lines) + "\n"


def stl() -> bytes:
    """Return the same as a binary STL file."""
    faces = b"".join(
        struct.pack("<12fH", 0, 0, 0, *(float(v) for corner in side for v in CORNERS[corner]), 0) for side in SIDES
    )
    return bytes(80) + struct.pack("<I", len(SIDES)) + faces


def vtk() -> str:
    """Return the same as a VTK file of text."""
    points = "\n".join(" ".join(map(str, corner)) for corner in CORNERS)
    cells = "\n".join(f"3 {a} {b} {c}" for a, b, c in SIDES)
    head = "# vtk DataFile Version 3.0\nmesh\nASCII\nDATASET POLYDATA\n"
    return f"{head}POINTS {len(CORNERS)} float\n{points}\nPOLYGONS {len(SIDES)} {4 * len(SIDES)}\n{cells}\n"


# What is no plain file ------------------------------------------------------------------------------------------


def fifo(path: Path) -> None:
    """Make a named pipe: whoever opens it waits for a writer."""
    os.mkfifo(path)


def endless(path: Path) -> None:
    """Make a link to a device that never ends."""
    path.symlink_to("/dev/zero")


def loop(path: Path) -> None:
    """Make a link to itself."""
    path.symlink_to(path.name)


def dangling(path: Path) -> None:
    """Make a link to nothing."""
    path.symlink_to("nowhere")


def folder(path: Path) -> None:
    """Make a folder."""
    path.mkdir()


def sparse(start: bytes | str = b"", size: int = 6 << 30) -> Callable[[Path], None]:
    """Return what makes a file of so many bytes that takes no space; it begins like a good one."""

    def make(path: Path) -> None:
        with path.open("wb") as file:
            file.write(start.encode() if isinstance(start, str) else start)
            file.truncate(size)

    return make


def no_files(start: bytes | str) -> Iterator[tuple[str, Any]]:
    """Yield what may stand where a file is expected, by name."""
    yield "FIFO", fifo
    yield "endless device", endless
    yield "folder", folder
    yield "link to itself", loop
    yield "link to nothing", dangling
    yield "empty", b""
    yield "one byte", b"\n"
    yield "6 GB", sparse(start)
    yield "6 GB of zeros", sparse()
    yield "zeros", bytes(5000)
    yield "binary", bytes(range(256)) * 40
    yield "not UTF-8", b'# caf\xe9\nname = "\xff\xfe"\n'


# Damage -----------------------------------------------------------------------------------------------------------


class Draw:
    """Which damage is drawn; another number draws other bytes and words from the same files."""

    number = 0


def damaged(data: bytes | str, seed: int, count: int) -> Iterator[bytes]:
    """Yield a file's bytes with random damage: bits, bytes and runs that are changed, cut, doubled or added."""
    rng = np.random.default_rng((Draw.number, seed))
    whole = data.encode() if isinstance(data, str) else data
    for number in range(count):
        made = bytearray(whole)
        for _ in range(1 + number % 3):
            at, length = int(rng.integers(len(made))), int(rng.integers(1, 1 + max(2, len(made) // 8)))
            match int(rng.integers(7)):
                case 0:
                    made[at] ^= 1 << int(rng.integers(8))
                case 1:
                    made[at] = int(rng.integers(256))
                case 2:
                    del made[at:]
                case 3:
                    del made[at : at + length]
                case 4:
                    made[at:at] = made[at : at + length]
                case 5:
                    made[at : at + length] = b"\xff" * len(made[at : at + length])
                case 6:
                    made[at:at] = rng.bytes(length)
            if not made:
                made = bytearray(b"\0")
        yield bytes(made)


def damaged_words(text: str, seed: int, count: int) -> Iterator[str]:
    """Yield a text in which some words are replaced by others that a parser may trip over."""
    rng = np.random.default_rng((Draw.number, seed))
    strange = ["nan", "-inf", "1e999", "-1", "0", '""', "{}", "[]", "true", "null", "'", '"', "[", "=", "\0", "é"]
    strange += ["1979-05-27", "0x10", "..", "-", "1e-300", "\u202e", "<x>", "&a", "*a"]
    strange += ["9" * 400, "!!python/object:os.system"]
    for _ in range(count):
        words = text.split(" ")
        for _ in range(1 + int(rng.integers(3))):
            words[int(rng.integers(len(words)))] = strange[int(rng.integers(len(strange)))]
        yield " ".join(words)
