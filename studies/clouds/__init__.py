"""How near estimator `cloud` comes to the base's normal and to the relief's slope: python -m studies.clouds.

`simtest validate studies/clouds/clouds.toml` runs it through the harness.
"""
