"""Functions with their first two derivatives: sums, products and chains of them, for any number of variables."""

import math
from collections.abc import Callable

import numpy as np

from simtest.geometry.vectors import dot
from simtest.runtime.arrays import Array, IntArray, Mask


class Jet:
    """A scalar or vector function of k variables at N points, with its derivatives up to an order of 0, 1 or 2.

    `value` has the shape (N,) or (N, 3), `gradient` one more axis of k, and `hessian` two; of a map of space the
    gradient is the Jacobian, with the derivative of component i along axis j at [:, i, j].
    """

    def __init__(self, *parts: Array) -> None:
        self.parts = parts

    @classmethod
    def variables(cls, points: Array, order: int = 2) -> "Jet":
        """Return the points themselves, shape (N, k), as a function of their coordinates."""
        count, k = points.shape
        derivatives = np.broadcast_to(np.eye(k), (count, k, k)), np.zeros((count, k, k, k))
        return cls(points, *derivatives[:order])

    @property
    def value(self) -> Array:
        """The function."""
        return self.parts[0]

    @property
    def gradient(self) -> Array:
        """Its first derivatives."""
        return self.parts[1]

    @property
    def hessian(self) -> Array:
        """Its second derivatives."""
        return self.parts[2]

    def each(self, function: Callable[[Array], Array]) -> "Jet":
        """Apply a linear function to value and derivatives alike."""
        return Jet(*(function(part) for part in self.parts))

    def rows(self, chosen: IntArray | Mask) -> "Jet":
        """Return the function at some of the points."""
        return self.each(lambda part: part[chosen])

    def with_rows(self, chosen: IntArray | Mask, other: "Jet") -> "Jet":
        """Return the function with the values of another at some of the points."""
        whole = self.each(np.array)
        for part, new in zip(whole.parts, other.parts, strict=True):
            part[chosen] = new
        return whole

    def __add__(self, other: "Jet") -> "Jet":
        """Return the sum of two functions."""
        return Jet(*(a + b for a, b in zip(self.parts, other.parts, strict=True)))

    def affine(self, scale: float, shift: Array | float = 0.0) -> "Jet":
        """Return scale f + shift."""
        return Jet(scale * self.value + shift, *(scale * part for part in self.parts[1:]))

    def linear(self, matrix: Array, shift: Array | float = 0.0) -> "Jet":
        """Return M f + shift of a vector f, from M of shape (3, 3)."""
        value, *derivatives = ((matrix @ _flat(part)).reshape(part.shape) for part in self.parts)
        return Jet(value + shift, *derivatives)

    def along(self, axis: Array) -> "Jet":
        """Return the component of a vector along a fixed one, shape (3,)."""
        return self.each(lambda part: (axis @ _flat(part)).reshape(len(part), *part.shape[2:]))

    def outer(self, axis: Array) -> "Jet":
        """Return a scalar times a fixed vector, shape (3,)."""
        return self.each(lambda part: np.multiply.outer(axis, part).swapaxes(0, 1))

    def __mul__(self, other: "Jet") -> "Jet":
        """Return the product of a scalar and a scalar or vector."""
        a = self if other.value.ndim == 1 else self.each(lambda part: part[:, None])
        parts = [a.value * other.value]
        if len(self.parts) > 1:
            parts.append(a.value[..., None] * other.gradient + other.value[..., None] * a.gradient)
        if len(self.parts) > 2:
            mixed = other.gradient[..., :, None] * a.gradient[..., None, :]
            bent = a.value[..., None, None] * other.hessian + other.value[..., None, None] * a.hessian
            parts.append(bent + mixed + np.swapaxes(mixed, -1, -2))
        return Jet(*parts)

    def squared(self) -> "Jet":
        """Return the squared length of a vector."""
        parts = [dot(self.value, self.value)]
        if len(self.parts) > 1:
            parts.append(2 * np.einsum("ni,nij->nj", self.value, self.gradient))
        if len(self.parts) > 2:
            both = np.swapaxes(self.gradient, 1, 2) @ self.gradient
            parts.append(2 * (both + np.einsum("ni,nijk->njk", self.value, self.hessian)))
        return Jet(*parts)

    def chain(self, value: Array, first: Array, second: Array) -> "Jet":
        """Return g(f) of a scalar f from g, g' and g'' at f, each of shape (N,)."""
        parts = [value]
        if len(self.parts) > 1:
            parts.append(first[:, None] * self.gradient)
        if len(self.parts) > 2:
            square = self.gradient[:, :, None] * self.gradient[:, None, :]
            parts.append(first[:, None, None] * self.hessian + second[:, None, None] * square)
        return Jet(*parts)

    def exp(self) -> "Jet":
        """Return the exponential of a scalar."""
        value = np.exp(self.value)
        return self.chain(value, value, value)

    def cos(self) -> "Jet":
        """Return the cosine of a scalar."""
        cosine = np.cos(self.value)
        return self.chain(cosine, -np.sin(self.value), -cosine)


def _flat(part: Array) -> Array:
    """Return vectors, or derivatives of such, as matrices, shape (N, 3, M)."""
    return part.reshape(len(part), 3, math.prod(part.shape[2:]))
