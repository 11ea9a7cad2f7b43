"""What flags, kinds of highlights, reasons of failure and parts of the uncertainty mean, in a sentence each.

The pages show these sentences where the names appear; docs/reference/estimators.md and docs/concepts/uncertainty.md
define the names.
"""

from collections import Counter
from collections.abc import Iterable

from simtest.errors import Reason
from simtest.estimators.protocol import Estimate

FLAGS = {
    "ambiguous": "the two candidates of the circle pose are hardly told apart: a margin below 2 standard deviations",
    "ambiguous_light": "the data do not tell which of several lights made the highlight; their mean position is used",
    "anisotropic_or_curved": "the cloud is longer than wide: the base is curved, or the relief has a direction",
    "base_unverified": "too little diffuse light is seen to check the cloud's centre against it",
    "clouds_refused": "another cloud of this picture got no answer",
    "cut": "a part of the cloud is out of view",
    "dim": "darker than the clipped highlights of the picture: the normal may only come near the bisector of light and "
    "camera",
    "light_offset": "a known light is not at the camera, as the estimator takes it to be; no error is reported",
    "misfit": "the modelled lobe does not explain the pixels of the highlight",
    "missing_isovalues": "some isovalues gave no ellipse, or enclose other highlights too; they were left out",
    "near_degenerate": "the peak fits neither candidate of the circle pose: the two-fold model does not apply",
    "not_elliptic": "an isophote is no ellipse, as where two highlights touch or the curvature changes under one",
    "off_peak": "the isophotes do not lead to the peak, as those of a body's shading: the normal is that at the peak, "
    "and the distance is in its error",
    "partial_arc": "an isophote runs into a border, where the highlight may be cut; it was left out, or fitted in part",
    "round": "noise hides the principal directions",
    "saturated": "the isophotes enclose clipped pixels",
    "small": "found by colour, with a radius at half height below 3 smoothing widths: smoothing makes it rounder",
    "streak": "more than ten times as long as wide: the centre is hardly determined along it",
    "unresolved": "a radius below 3 px at half height: the normal is that of the spot's centre, without axis ratio or "
    "curvature",
    "vignetted": "the isophotes reach to where too little light is left to correct the falloff",
    "wide": "the cloud is too long for one normal of its base",
}
"""By flag of an estimate."""

KINDS = {
    "isolated": "a highlight of its own, with nested elliptic isophotes",
    "clipped": "a highlight whose peak is clipped by the sensor",
    "small": "too few pixels to judge its shape",
    "cluster": "several highlights that touch; they carry no single normal",
    "elongated": "a streak, as on an instrument or a fold",
    "merged": "two highlights grown together",
    "border": "cut by the border of the view, or at an edge whose step of light outshines it",
    "inter_reflection": "coloured light: reflected by tissue before",
    "unclear": "its shape or its surroundings are not those of a highlight",
}
"""By kind of a highlight that was found by colour (docs/concepts/detection.md)."""

KIND_NAMES = {"small": "few pixels", "inter_reflection": "inter-reflection"}
"""Kinds as people read them, where files have another name: `small` is a flag too, of another meaning."""

REASONS = {str(reason): reason.meaning for reason in Reason}
"""By reason of a failure."""

PARTS = {
    "noise": "the sensor's noise",
    "resolution": "pixel size, smoothing, blur and coding, as seen in the fit's residuals",
    "shape": "drift of the centre over the isovalues, where the curvature changes inside the highlight",
    "light_offset": "the light's position beside the camera, unknown or given with a spread",
    "camera": "focal length, principal point and distortion, where they are guesses",
    "distance": "the unknown distance of the surface",
    "response": "unknown response, sharpening and falloff",
    "relief": "slope of the fine relief, where the normal of the smooth base is wanted",
    "stated": "the estimator reports one covariance without parts",
}
"""By part of the budget of an uncertainty (docs/concepts/uncertainty.md)."""

UNTOLD_ERROR = {
    "light_offset": "a known light is not at the camera, which this method ignores, so it cannot tell its error",
    "circle_pose": "circle_pose reports an error on surfaces that are known to be planes alone",
    "other": "the noise of the picture could not be estimated, fewer than two isophotes are ellipses, or the estimator "
    "reports no error",
}
"""Why an estimate has no ±."""

TERMS = {
    "best": "The best normal of a highlight has the smallest reported error. Normals without one come last.",
    "score": "The score, 0 to 1, says how much a spot looks like a highlight. It is no probability, and was fitted on "
    "rendered spots that fool (docs/measured/foolers.md). Below the least score a spot has no best normal. ± holds if "
    "it is a highlight.",
    "tilt": "Tilt is the angle between the normal and the camera's optical axis: 0° faces the camera.",
    "deviation": "± is the root mean square error that is expected of the normal, all parts of its budget together. "
    "The error should stay below 1.7 to 2 times this figure for 95 % of the normals.",
    "arrow": "An arrow shows the part of the normal across the view. It points to the side that the surface faces; a "
    "steep surface has a long arrow, and one that faces the camera has a dot alone.",
    "cloud": "Rough tissue breaks one highlight into a cloud of glints. The cloud's centre carries the normal of the "
    "smooth base surface; each glint alone carries the normal of the relief.",
}
"""Terms that the page of a picture uses."""


def why_no_error(name: str, result: Estimate) -> str:
    """Return why the estimate of the named estimator reports no error; an empty text where it reports one."""
    if result.covariance is not None:
        return ""
    if "light_offset" in result.flags:
        return UNTOLD_ERROR["light_offset"]
    return UNTOLD_ERROR["circle_pose" if name == "circle_pose" else "other"]


def kind_name(kind: str | None) -> str:
    """Return the name of a kind of highlight for people; an empty one where nothing judged the highlight."""
    return KIND_NAMES.get(kind or "", kind or "")


def kinds_counted(kinds: Iterable[str]) -> str:
    """Count highlights by kind, the most frequent first: "12 cluster, 3 border"."""
    counts = Counter(kind_name(kind) for kind in kinds)
    return ", ".join(f"{count} {name}" for name, count in counts.most_common())
