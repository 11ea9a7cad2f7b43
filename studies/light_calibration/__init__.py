"""How well `simtest calibrate light` measures planted lights: `python -m studies.light_calibration`."""
