"""Functions of (u, v) with their first and second partial derivatives: sums, products and the chain rule."""

from dataclasses import dataclass

import numpy as np

from simtest.runtime.arrays import Array, IntArray


@dataclass(frozen=True)
class Jet:
    """A function of (u, v) with its first and second partial derivatives, each of shape (N,) or (N, 3)."""

    f: Array
    u: Array
    v: Array
    uu: Array
    uv: Array
    vv: Array

    def __add__(self, other: "Jet") -> "Jet":
        """Return the sum of two functions."""
        return Jet(*(a + b for a, b in zip(self.parts(), other.parts(), strict=True)))

    def parts(self) -> tuple[Array, ...]:
        """Return value and derivatives: f, u, v, uu, uv, vv."""
        return self.f, self.u, self.v, self.uu, self.uv, self.vv

    def rows(self, chosen: IntArray) -> "Jet":
        """Return the function at some of the points."""
        return Jet(*(part[chosen] for part in self.parts()))

    def with_rows(self, chosen: IntArray, other: "Jet") -> "Jet":
        """Return the function with the values of another at some of the points."""
        made = []
        for part, new in zip(self.parts(), other.parts(), strict=True):
            copy = part.copy()
            copy[chosen] = new
            made.append(copy)
        return Jet(*made)

    def along(self, axis: Array) -> "Jet":
        """Return the component of a vector along a fixed one, shape (3,)."""
        return Jet(*(part @ axis for part in self.parts()))

    def chain(self, value: Array, first: Array, second: Array) -> "Jet":
        """Return g(f) of a scalar f from g, g' and g'' at f, each of shape (N,)."""
        return Jet(
            f=value,
            u=first * self.u,
            v=first * self.v,
            uu=second * self.u * self.u + first * self.uu,
            uv=second * self.u * self.v + first * self.uv,
            vv=second * self.v * self.v + first * self.vv,
        )


def times(a: Jet, b: Jet) -> Jet:
    """Return the product of a scalar and a scalar or vector."""
    A = a if b.f.ndim == 1 else Jet(*(part[:, None] for part in a.parts()))
    return Jet(
        f=A.f * b.f,
        u=A.u * b.f + A.f * b.u,
        v=A.v * b.f + A.f * b.v,
        uu=A.uu * b.f + 2 * A.u * b.u + A.f * b.uu,
        uv=A.uv * b.f + A.u * b.v + A.v * b.u + A.f * b.uv,
        vv=A.vv * b.f + 2 * A.v * b.v + A.f * b.vv,
    )


def squared(x: Jet) -> Jet:
    """Return the squared length of a vector."""

    def dot(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("ni,ni->n", a, b))

    return Jet(
        f=dot(x.f, x.f),
        u=2 * dot(x.f, x.u),
        v=2 * dot(x.f, x.v),
        uu=2 * (dot(x.u, x.u) + dot(x.f, x.uu)),
        uv=2 * (dot(x.u, x.v) + dot(x.f, x.uv)),
        vv=2 * (dot(x.v, x.v) + dot(x.f, x.vv)),
    )
