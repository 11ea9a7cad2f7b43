"""Sensors and video processors by name; docs/realism.md says where their numbers come from."""

from typing import Any, Literal

SensorPreset = Literal["colonoscope_hd", "laparoscope_hd", "old_sd"]

PRESETS: dict[str, dict[str, Any]] = {
    # One chip behind a mosaic, as in the tip of a colonoscope; coded as the colonoscopies of HyperKvasir are.
    "colonoscope_hd": {
        "point_spread_px": 0.6,
        "exposure": {"average": 0.45},
        "mosaic": {"pattern": "rggb", "demosaicing": "edge_aware"},
        "colour": {
            "white_balance": [1.6, 1.0, 1.8],
            "matrix": [[1.5, -0.4, -0.1], [-0.2, 1.4, -0.2], [0.0, -0.5, 1.5]],
        },
        "full_well": 8000,
        "read_noise": 6.0,
        "response": {"type": "srgb"},
        "sharpening": {"radius_px": 1.3, "amount": 0.9},
        "overlay": {},
        "bits": 8,
        "coding": {"type": "jpeg", "quality": 75, "chroma": "4:2:0"},
    },
    # Three chips behind a prism, outside the patient: no mosaic, less noise.
    "laparoscope_hd": {
        "point_spread_px": 0.8,
        "exposure": {"average": 0.35},
        "full_well": 20000,
        "read_noise": 8.0,
        "response": {"type": "srgb"},
        "sharpening": {"radius_px": 1.5, "amount": 0.7},
        "overlay": {},
        "bits": 8,
        "coding": {"type": "jpeg", "quality": 92, "chroma": "4:2:0"},
    },
    # A processor of standard definition whose picture was enlarged.
    "old_sd": {
        "point_spread_px": 0.8,
        "exposure": {"average": 0.45},
        "mosaic": {"pattern": "rggb", "demosaicing": "bilinear"},
        "colour": {"white_balance": [1.5, 1.0, 1.7]},
        "full_well": 5000,
        "read_noise": 12.0,
        "response": {"type": "srgb"},
        "sharpening": {"radius_px": 2.0, "amount": 1.2},
        "scaling": {"factor": 0.6, "method": "linear"},
        "overlay": {},
        "bits": 8,
        "coding": {"type": "jpeg", "quality": 85, "chroma": "4:2:0"},
    },
}
