"""How near estimator `cloud` comes to the base's normal and to the relief's slope."""
