"""Frames, units and signs, on one page. Constants only.

Camera frame
    OpenCV: x right, y down, z forward; the camera centre V is the origin. Lengths in mm.
Angles
    Radians in code, degrees in reports and in names that end in ``_deg``.
Pixels
    The centre of pixel (column i, row j) is (i + 0.5, j + 0.5). Routines that return integer-centred
    coordinates (`skimage.measure.find_contours`, OpenCV) are shifted once, in `simtest.geometry`.
Normals
    Unit, facing the camera: N . P < 0 for the surface point P (not N_z < 0, which is wrong off axis).
Curvature
    Signed, convex towards the camera positive. S is the shape operator, dN = S du, and
    k_min <= k_max are its eigenvalues in 1/mm.
Transforms
    ``b_from_a`` maps coordinates of frame a to frame b.
Isovalues
    t is relative to the smoothed peak of its region of interest.
Noise
    sigma is the standard deviation as a share of full scale after exposure.
"""

PIXEL_CENTRE = 0.5
"""Offset of a pixel's centre from its integer index, in px."""

DEFAULT_SMOOTHING_PX = 2.0
"""Standard deviation of the Gaussian that smooths a frame before isophotes are traced, in px."""

PAPER_SMOOTHING_PX = 3.0
"""The same in the published protocol, in px. The article does not state it; its slope against n and its best isovalue
are those of about 3 px (docs/measured/published.md)."""

CIRCLE_POSE_ISOVALUE = 0.5
"""Default isovalue of `circle_pose` in rendered experiments."""

CONE_AXIS_ISOVALUES = (0.3, 0.4, 0.5, 0.6, 0.7)
"""Default isovalues of `cone_axis`."""

HIGHLIGHT_ISOVALUE = 0.5
"""A highlight is the region enclosed by its isophote at this value."""

HIGHLIGHT_CONTRAST_SIGMA = 10.0
"""A highlight's peak stands at least this many noise standard deviations above its surroundings."""

HIGHLIGHT_MIN_GAIN = 0.25
"""Least abs(1 + d k) of an isolated highlight: below it the highlight is a streak or a ring."""

HIGHLIGHT_ELLIPSE_RESIDUAL = 0.045
"""Most that the isophote of an isolated highlight at t = 0.7 differs from an ellipse, RMS, as a share of its radius;
noise is allowed for on top."""

HIGHLIGHT_WIDTH_EXCESS = 0.03
"""Most that the isophote of an isolated highlight at t = 0.8 is wider than a Gaussian's of the same width at t = 0.5,
as a share; noise is allowed for on top."""

SPECULAR_PEAK_SHARE = 0.1
"""A pixel shows a highlight where the direct specular light behind the sensor is at least this share of the highlight's
own peak ..."""

SPECULAR_DIFFUSE_RATIO = 1.0
"""... and at least this many times the light from elsewhere at that pixel."""

SPECULAR_MIN_AREA_PX = 12
"""A highlight of fewer pixels need not be found: no ellipse can be fitted to it."""

EDGES_PER_HALF_WIDTH = 2.0
"""Edges needed in a half-width: with two, the triangles cost less than 0.05 deg and 1 % (docs/howto/scenes.md)."""

ON_INSTRUMENT = "on_instrument"
"""Column of results of scenes with instruments: whether a detection shows one, and no true highlight."""

MOTION = "motion"
"""Estimator of the rows that hold what further views tell of curvatures."""

MOTION_COLUMNS = (
    "motion_over_d", "motion_sign_1", "motion_sign_2", "motion_gain_1", "motion_gain_2", "motion_margin_1",
    "motion_margin_2", "motion_distance2", "motion_fits",
)  # fmt: skip
"""Columns of results of scenes with further views, all numbers (docs/howto/pictures.md)."""
