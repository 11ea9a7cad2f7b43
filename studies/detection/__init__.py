"""Detection of specularities on rendered frames whose specular pixels are known, beside two other detectors."""
