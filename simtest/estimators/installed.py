"""The group of installed estimators: their names and packages are asked for without loading any."""

from simtest.runtime.resources import EntryPointGroup

ESTIMATORS = EntryPointGroup("simtest.estimators", "estimator")
