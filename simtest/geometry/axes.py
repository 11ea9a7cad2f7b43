"""Assignments of a vector's three channels to the camera's axes, for normals that others have written.

An assignment is written as the camera's own axis (x right, y down, z forward) that each channel holds, with its sign:
"x,-y,-z" says that the first channel holds x, the second -y (up) and the third -z (towards the camera).
"""

import itertools

import numpy as np

from simtest.runtime.arrays import Array

NAMED = {"opencv": "x,y,z", "opengl": "x,-y,-z", "directx": "x,y,-z"}
"""Common axes by name: y down and z forward; y up and z towards the camera; y down and z towards the camera."""

ALL = tuple(
    ",".join(f"{sign}{axis}" for sign, axis in zip(signs, axes, strict=True))
    for axes in itertools.permutations("xyz")
    for signs in itertools.product(("", "-"), repeat=3)
)
"""All 48 assignments of channels to axes."""


def described(axes: str) -> str:
    """Return axes with their name, if they have one."""
    name = next((name for name, own in NAMED.items() if own == axes), None)
    return axes if name is None else f"{axes} ({name})"


def matrix(axes: str) -> Array:
    """Return the signed permutation, shape (3, 3), that maps a channel vector to the camera frame."""
    turned = np.zeros((3, 3))
    for channel, axis in enumerate(axes.split(",")):
        turned["xyz".index(axis[-1]), channel] = -1.0 if axis[0] == "-" else 1.0
    return turned
