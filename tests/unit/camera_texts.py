"""Camera files as the programs of each format write them."""

import numpy as np


def written(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


ROS_FILE = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.78, 0.00000, 305.59,
         0.     , 437.35, 243.74,
         0.     , 0.    , 1.    ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361, 0.123, 0.001, -0.0002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""

ROS_MESSAGE = """header:
  stamp:
    sec: 5
    nanosec: 0
  frame_id: endoscope
height: 480
width: 640
distortion_model: equidistant
d:
- 0.02
- -0.01
- 0.003
- 0.0
k:
- 300.0
- 0.0
- 319.5
- 0.0
- 300.0
- 239.5
- 0.0
- 0.0
- 1.0
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""

JSON = (
    '{"image_width": 640, "image_height": 480, "K": [[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]], '
    '"D": [-0.2, 0.05, 0.0, 0.0]}'
)

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.067, 0.00087, 0.00011]
  distortion_model: radtan
  intrinsics: [461.6, 460.1, 362.6, 246.0]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.0, -1.0, 0.0, -0.11]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.003]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.02, -0.01, 0.003, -0.0004]
  distortion_model: equidistant
  intrinsics: [300.5, 290.1, 321.2, 239.1]
  resolution: [640, 480]
"""


def vicalib(kind, params, width=640, height=480):
    return (
        f'<rig>\n<camera>\n<camera_model name="" index="0" serialno="0" type="{kind}" version="0">\n'
        f"<width> {width} </width><height> {height} </height>\n<!-- Use RDF matrix -->\n<right> [ 1; 0; 0 ] </right>\n"
        f"<down> [ 0; 1; 0 ] </down>\n<forward> [ 0; 0; 1 ] </forward>\n<params> [ {params} ] </params>\n"
        "</camera_model>\n<pose><T_wc> [ 1, 0, 0, 0; 0, 1, 0, 0; 0, 0, 1, 0 ] </T_wc></pose>\n</camera>\n</rig>\n"
    )


PHOTOMETRIC = (
    '<rig><camera><camera_model index="0" type="gamma"><gamma> [ 2.2 ] </gamma></camera_model></camera><light>'
    '<light_model index="0" type="sls"><sigma> 1.0 </sigma><mu> 2.7 </mu><P> [ 0.0; -0.001; -0.003 ] </P>'
    "<D> [ 0.0; 0.0; 1.0 ] </D></light_model></light></rig>"
)
"""EndoMapper's photometric calibration."""

C3VD = {
    "width": 1350, "height": 1080, "cx": 678.544839263292, "cy": 542.975887548343, "a0": 769.243600037458, "a1": 0.0,
    "a2": -0.000812770624150226, "a3": 6.25674244578925e-07, "a4": -1.19662182144280e-09, "c": 0.999986882249990,
    "d": 0.00288273829525059, "e": -0.00296316513429569,
}  # fmt: skip

STRUCT = {
    "IntrinsicMatrix": np.array([[500.0, 0.0, 0.0], [3.0, 480.0, 0.0], [321.0, 241.0, 1.0]]),
    "RadialDistortion": np.array([-0.3, 0.1, 0.01]),
    "TangentialDistortion": np.array([0.001, -0.002]),
    "ImageSize": np.array([480.0, 640.0]),
    "WorldUnits": "mm",
}
"""MATLAB's cameraParameters."""

FISHEYE_STRUCT = {
    "MappingCoefficients": np.array([C3VD[key] for key in ("a0", "a2", "a3", "a4")]),
    "ImageSize": np.array([1080.0, 1350.0]),
    "DistortionCenter": np.array([C3VD["cx"] + 1, C3VD["cy"] + 1]),
    "StretchMatrix": np.array([[C3VD["c"], C3VD["d"]], [C3VD["e"], 1.0]]),
}
"""MATLAB's fisheyeIntrinsics, whose first pixel is (1, 1); it names x before y and looks along z."""

TOML = """width = 640
height = 480
fx = 300.0
fy = 300.0
distortion = { type = "kannala_brandt", k1 = 0.01 }
view_mask = { radius = 200.0 }
"""
