"""Metadata of a sample: the last member of its files in a shard, a JSON object, key by key."""

from typing import NotRequired, TypedDict

from pydantic import JsonValue

from simtest.spec.camera_tables import CameraDescription


class AnatomyMeta(TypedDict):
    """Anatomy that a sample shows (see `simtest.dataset.plan.Anatomy`)."""

    family: int
    number: int
    seed: int | None
    surface: str


class InstanceMeta(TypedDict):
    """Pixels of an isolated highlight in the field instance: how many, or why none."""

    lobe_peak: float  # share of full scale; above 1 it is clipped
    instance_px: int | None
    no_instance: str | None


class HighlightMeta(TypedDict):
    """A true highlight; camera frame, mm."""

    light: int
    bp_px: list[float]
    position_mm: list[float]
    normal: list[float]
    distance_mm: float
    kd_min: float
    kd_max: float
    isolated: bool
    why_not: str | None
    direction_min: list[float] | None
    peak_snr: float | None
    lit: bool
    hidden: bool
    region: NotRequired[InstanceMeta]  # of isolated ones
    # Of the base
    normal_base: list[float]
    kd_min_base: float
    kd_max_base: float
    pool: bool


class EllipseMeta(TypedDict):
    """Ellipse fitted to a detection's isophote."""

    isovalue: float
    centre_px: list[float]
    semi_axes_px: list[float]
    angle_deg: float


class DetectionMeta(TypedDict):
    """A highlight found in the frame."""

    box_px: list[int]
    peak_px: list[float] | None
    ellipse: EllipseMeta | None


EstimateMeta = dict[str, str | int | float | bool]
"""A row of an experiment's results by column; columns without a value are left out."""


class SampleMeta(TypedDict):
    """Everything about a sample that is no image; `sha256` holds the hashes of its images."""

    key: str
    index: int
    dataset: str
    split: str
    anatomy: AnatomyMeta
    drawn: dict[str, JsonValue]
    camera: CameraDescription
    world_from_camera: list[list[float]]  # 4 x 4, mm
    lights_mm: list[list[float]]
    brightest_mm: float | None  # distance of the brightest highlight, to which known.distance_error is relative
    full_scale: float
    scene: dict[str, JsonValue]
    attempt: int
    highlights: list[HighlightMeta]
    clouds: NotRequired[list[dict[str, JsonValue]]]  # highlight points of the base below a relief
    visible_highlights: NotRequired[list[dict[str, JsonValue]]]  # with relief, or where their pixels are kept
    detections: list[DetectionMeta]
    estimates: list[EstimateMeta]
    depth_scale_mm: float
    polyps: NotRequired[list[dict[str, JsonValue]]]  # those of the anatomy, seen or not; where there are any
    instrument_share: NotRequired[float]  # of the pixels, on an instrument; where the scene lists instruments
    sha256: NotRequired[dict[str, str]]


def has_relief(meta: SampleMeta) -> bool:
    """Return whether a sample's surface has a relief, so that the truth of its base is stored beside the fine one."""
    surface = meta["scene"].get("surface")
    return isinstance(surface, dict) and surface.get("relief") is not None


def has_debris(meta: SampleMeta) -> bool:
    """Return whether stool or bile lies on a sample's tissue."""
    reflectance = meta["scene"].get("reflectance")
    albedo = reflectance.get("albedo") if isinstance(reflectance, dict) else None
    return isinstance(albedo, dict) and albedo.get("debris") is not None
