"""Ten faults that were thought of after the canaries were done, and for which none was changed.

They show what share of faults outside the list is named: `python -m studies.mutants --further`.
"""

from studies.mutants.mutant import Mutant, mutant

FURTHER: tuple[Mutant, ...] = (
    mutant("distance of a highlight is its z", "columns", "simtest.rendering.highlights:describe",
           "distance=float(points.distance[i]),", "distance=float(points.position[i][2]),"),
    mutant("spin of a surface forgotten", "labels", "simtest.surfaces.analytic:placement",
           "x = np.array([np.cos(spin), np.sin(spin), 0.0])", "x = np.array([1.0, 0.0, 0.0])"),
    mutant("gain of the exposure inverted", "exposure", "simtest.simulation.rendered_view:_full_scale",
           "return radiance / exposure.gain", "return radiance * exposure.gain"),
    mutant("tangential coefficients of MATLAB swapped", "files", "simtest.spec.camera_formats.matlab:read_matlab",
           '("k1", "k2", "k3", "p1", "p2")', '("k1", "k2", "k3", "p2", "p1")'),
    mutant("cut corners of a field of view half as long", "masks", "simtest.geometry.camera:ViewMask.contains",
           "self.radius + height - self.corner", "self.radius + height - self.corner / 2"),
    mutant("second band of a relief lost", "tissue", "simtest.surfaces.relief_field:_add", "lambda a, b: HeightJets",
           "lambda a, b: a or HeightJets"),
    mutant("part by an untold falloff four times too large", "budget", "simtest.estimators.prior_parts:falloff_part",
           "_unit_variance(power) * np.outer(shift, shift)", "4 * _unit_variance(power) * np.outer(shift, shift)"),
    mutant("soft edge of a spot outside its rim", "falloff", "simtest.rendering.emission:factor",
           'values["rim"] - angle, values["edge"]', 'values["rim"] + values["edge"] - angle, values["edge"]'),
    mutant("mean of the better candidates is that of the proposed ones", "statistics",
           "simtest.validation.statistics:figures", 'np.mean, answered["error_oracle_deg"].to_numpy()',
           'np.mean, answered["error_deg"].to_numpy()'),
    mutant("of two detections the farther one is matched", "counts", "simtest.validation.matching:match",
           "in sorted(pairs):", "in sorted(pairs, reverse=True):"),
)  # fmt: skip
