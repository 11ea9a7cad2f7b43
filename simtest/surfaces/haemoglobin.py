"""Absorption of light by blood, and how deep light reaches into tissue, for the channels of a camera.

The extinction of haemoglobin is S. Prahl's tabulation (omlc.org/spectra/hemoglobin) of data by W. B. Gratzer and
N. Kollias; the scattering is the mean of soft tissues in S. L. Jacques, "Optical properties of biological tissues: a
review", Phys. Med. Biol. 58 (2013) R37, table 2.
"""

import math

import numpy as np

from simtest.runtime.arrays import Array

EXTINCTION = (
    # Red, 600 to 650 nm: wavelength, nm; HbO2 and Hb, 1/(cm mol/l)
    ((600, 3200.0, 14677.2), (610, 1506.0, 9443.6), (620, 942.0, 6509.6), (630, 610.0, 5148.8), (640, 442.0, 4345.2),
     (650, 368.0, 3750.12)),
    # Green, 510 to 570 nm
    ((510, 20035.2, 25773.6), (520, 24202.4, 31589.6), (530, 39956.8, 39036.4), (540, 53236.0, 46592.0),
     (550, 43016.0, 53412.0), (560, 32613.2, 53788.0), (570, 44496.0, 45072.0)),
    # Blue, 450 to 490 nm
    ((450, 62816.0, 103292.0), (460, 44480.0, 23388.8), (470, 33209.2, 16156.4), (480, 26629.2, 14550.0),
     (490, 23684.4, 16684.0)),
)  # fmt: skip
"""Molar extinction in the bands of the three channels."""

HAEMOGLOBIN_G_PER_L = 150.0
GRAM_PER_MOL = 64500.0

SOFT_TISSUE = (1.89, 1.3)
"""Reduced scattering a (lambda / 500 nm)^-b of soft tissue: a, 1/mm, and b."""

TISSUE_SATURATION = 0.7
"""Share of oxygenated haemoglobin in the ground: 0.72 in normal colon mucosa (Friedland et al. 2003), 0.67 (Wang et al.
2009); see docs/concepts/tissue.md."""


def blood_absorption(saturation: float) -> Array:
    """Return the absorption coefficient of whole blood, 1/mm, shape (3,), red, green and blue.

    mu_a = ln(10) (S e_HbO2 + (1 - S) e_Hb) c with the molar concentration c of haemoglobin, averaged over each band.
    """
    means = np.array([np.mean(np.array(band)[:, 1:], axis=0) for band in EXTINCTION])
    molar = means @ [saturation, 1 - saturation]
    return np.asarray(math.log(10) * molar * HAEMOGLOBIN_G_PER_L / GRAM_PER_MOL / 10)


def reach(blood: float) -> Array:
    """Return the length, mm, shape (3,), over which the light that comes back from below falls to 1/e.

    Half of the penetration depth 1 / sqrt(3 mu_a (mu_a + mu_s')) of diffuse light, since it goes down and up again.

    Parameters
    ----------
    blood : float
        Share of the tissue's volume that is blood.
    """
    wavelength = np.array([np.mean([row[0] for row in band]) for band in EXTINCTION])
    scattering = SOFT_TISSUE[0] * (wavelength / 500) ** -SOFT_TISSUE[1]
    absorption = blood * blood_absorption(TISSUE_SATURATION)
    return np.asarray(0.5 / np.sqrt(3 * absorption * (absorption + scattering)))
