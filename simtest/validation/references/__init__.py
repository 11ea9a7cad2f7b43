"""References in the formats of public data sets: what their maps mean is stated (`formats`) and checked (`read`)."""
