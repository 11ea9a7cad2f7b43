"""What names a fault: for each kind of mutant, the canaries and the gate's quantities whose subject it is.

A failing canary names the fault where its name stands under the fault's kind. Any other failing canary is an alarm that
leads nowhere near it, and does not count.
"""

KINDS: dict[str, tuple[str, ...]] = {
    "pixel centre": ("sightlines", "sub_pixel", "photometry", "camera files"),
    "conic": ("circle_pose", "conditioning", "ellipse", "isovalue", "published"),
    "lens": ("lens", "lens_rays"),
    "masks": ("view_mask", "mask", "instances"),
    "noise width": ("noise", "shot_noise", "read_noise", "noise_model", "noise_estimate"),
    "sensor curve": ("response", "quantisation"),
    "vignetting": ("vignetting",),
    "point spread": ("point_spread",),
    "smoothing": ("smoothing",),
    "lobe width": ("photometry", "phong_lobe", "ggx_lobe", "film", "lobe_width"),
    "falloff": ("photometry", "emission"),
    "light sign": ("rig", "photometry", "bisector"),
    "bounces": ("bounces",),
    "units": ("emission", "rig", "truth", "light_offset", "columns", "budget"),
    "tissue": ("film", "relief", "translucency", "glints"),
    "labels": ("labels", "truth", "rotated_camera", "cylinder", "columns"),
    "seeds": ("noise", "seeds"),
    "statistics": ("statistics",),
    "counts": ("statistics", "counts"),
    "columns": ("columns", "laws", "published"),
    "thresholds": ("detection", "isovalue"),
    "ladder": ("error ladder",),
    "covariance": ("coverage",),
    "budget": ("budget",),
    "estimators": ("axis_ratio", "curvature", "bisector"),
    "encodings": ("encoding",),
    "files": ("camera files",),
    "exposure": ("exposure",),
    "control": (),
}
"""Names of canaries (their column `experiment`) by kind of fault."""

QUANTITIES: dict[str, tuple[str, ...]] = {
    "counts": ("unanswered", "false", "n"),
    "covariance": ("coverage95",),
    "budget": ("coverage95",),
    "thresholds": ("unanswered", "false", "n"),
    "columns": ("axis_ratio",),
    "estimators": ("axis_ratio", "mean_deg"),
}
"""Quantities of the gate that name a fault of a kind."""


MEASURES: dict[str, tuple[str, ...]] = {
    "sightlines": ("sightlines",), "sub_pixel": ("isophotes",), "isovalue": ("isophotes",),
    "conditioning": ("conditioning",), "circle_pose": ("pose",), "ellipse": ("ellipse",), "published": ("published",),
    "photometry": ("photometry",), "exposure": ("exposure",), "truth": ("truth",), "plane": ("plane_errors",),
    "light_offset": ("plane_errors",),
    "cylinder": ("curved_errors",), "axis_ratio": ("curved_errors",), "rotated_camera": ("rotated",),
    "noise": ("noises", "protocol_noise"), "seeds": ("branches",), "lens": ("lenses",), "lens_rays": ("lens_rays",),
    "view_mask": ("view_masks",), "camera files": ("camera_files",), "rig": ("rigs",),
    "bisector": ("rigs", "told_light"),
    "shot_noise": ("photon_noise",), "read_noise": ("photon_noise",), "noise_model": ("stated_noise",),
    "noise_estimate": ("stated_noise",), "response": ("curves",), "quantisation": ("quantisation",),
    "vignetting": ("vignetting",), "point_spread": ("widths",), "smoothing": ("widths",), "ggx_lobe": ("lobes",),
    "film": ("lobes",), "lobe_width": ("lobes",), "phong_lobe": ("emission",), "emission": ("emission",),
    "bounces": ("bounces",), "labels": ("surfaces", "frame_files"), "mask": ("surfaces",), "instances": ("dataset",),
    "encoding": ("encodings", "dataset", "frame_files"), "statistics": ("statistics",), "counts": ("counts",),
    "columns": ("columns",), "laws": ("law_values",), "detection": ("thresholds",), "coverage": ("coverage", "columns"),
    "budget": ("budgets",), "curvature": ("budgets",), "relief": ("relief",), "translucency": ("translucency",),
    "glints": ("glints",), "error ladder": ("error_ladder",),
}  # fmt: skip
"""What measures each canary: functions of `simtest.nightly.canaries`."""


def measures_of(kind: str) -> list[str]:
    """Return what measures the canaries that name a kind of fault, each once."""
    return list(dict.fromkeys(measure for name in KINDS[kind] for measure in MEASURES[name]))


def naming(kind: str, failed: list[str]) -> list[str]:
    """Return which of the failed canaries name a fault of a kind, each once, in their order."""
    return [name for name in dict.fromkeys(failed) if name in KINDS[kind]]
