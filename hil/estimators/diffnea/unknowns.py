"""From free coordinates to the coefficients of a regressor, with the exact Jacobian.

The coordinates u are those of links and rotors (`Bodies`), then the friction coefficients of every
joint, then their shapes. Coefficients that cannot be negative are softplus(u) times a scale, shapes
go between their bounds by a logistic curve. The values are base parameters, friction coefficients
and shapes, joint by joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from hil.core import FloatArray
from hil.dynamics import BaseParameters
from hil.estimators.diffnea.bodies import Bodies
from hil.estimators.diffnea.forms import Form
from hil.estimators.diffnea.minimise import Local

SHAPE_EDGE = 0.01
"""A shape this share of its (logarithmic) range from a bound sits at the bound."""

AT_ZERO = 1e-3
"""A friction coefficient this share of its scale is 0 for all one can tell."""


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """What is sought.

    Attributes:
        bodies: Links and rotors.
        fold: (b, 11n) base parameters of full ones.
        form: Friction law of every joint.
        scale: (n, k) size of friction coefficients, in their units.
    """

    bodies: Bodies
    fold: FloatArray
    form: Form
    scale: FloatArray

    @property
    def counts(self) -> tuple[int, int, int]:
        """Base parameters b, friction coefficients n·k and shapes n·s."""
        return len(self.fold), self.scale.size, len(self.scale) * len(self.form.shapes)

    @property
    def linear(self) -> int:
        """How many values are coefficients of the regressor."""
        return len(self.fold) + self.scale.size

    def start(self) -> FloatArray:
        """Coordinates of the nominal arm with friction of usual size and shape."""
        friction = np.where(self.form.nonnegative, np.log(np.expm1(1.0)), 0.0)
        shapes = [np.log(s.start / s.low) / np.log(s.high / s.low) for s in self.form.shapes]
        middle = np.log(np.array(shapes) / (1.0 - np.array(shapes)))
        n = len(self.scale)
        return np.concatenate([self.bodies.start, np.tile(friction, n), np.tile(middle, n)])

    def at(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (b + nk + ns,) and their Jacobian (b + nk + ns, U)."""
        b, nk, ns = self.counts
        inner = self.fold.shape[1]
        slope = np.zeros((b + nk + ns, inner + nk + ns))
        slope[:b, :inner] = self.fold @ self.bodies.jacobian(u)
        friction, friction_slope = self._friction(u[inner : inner + nk])
        shapes, shapes_slope = self._shapes(u[inner + nk :])
        diagonal = np.concatenate([friction_slope, shapes_slope])
        slope[np.arange(b, b + nk + ns), np.arange(inner, inner + nk + ns)] = diagonal
        base = self.fold @ self.bodies.parameters(u)
        return np.concatenate([base, friction, shapes]), slope

    def divergence(self, u: FloatArray) -> Local:
        """How far links, rotors and friction coefficients are from nominal or usual ones.

        A coefficient that cannot be negative is a 1×1 pseudo-inertia too.
        """
        inner, nk = self.fold.shape[1], self.scale.size
        bodies = self.bodies.divergence(u[:inner])
        x, bounded = u[inner : inner + nk], np.tile(self.form.nonnegative, len(self.scale))
        ratio = np.where(bounded, np.logaddexp(0.0, x), 1.0)
        slope = np.where(bounded, expit(x), 0.0) / ratio
        gradient, curvature = np.zeros(len(u)), np.zeros((len(u), len(u)))
        gradient[:inner], curvature[:inner, :inner] = bodies.gradient, bodies.curvature
        own = np.arange(inner, inner + nk)
        gradient[own], curvature[own, own] = slope * (ratio - 1.0), slope**2
        friction = float(np.sum(ratio - np.log(ratio) - 1.0))
        return Local(bodies.cost + friction, gradient, curvature)

    def notes(self, u: FloatArray, joints: tuple[str, ...]) -> tuple[str, ...]:
        """What ended at its bound, for people."""
        _, nk, ns = self.counts
        values = self.at(u)[0]
        k, terms = len(self.form.terms), self.form.terms
        share = (values[self.linear - nk : self.linear].reshape(-1, k) / self.scale) < AT_ZERO
        zero = np.argwhere(share & self.form.nonnegative)
        found = [f"{joints[j]}.{terms[i]} is at its bound 0" for j, i in zip(*zero.T, strict=True)]
        place = expit(u[len(u) - ns :]).reshape(len(joints), -1)
        for j, i in np.argwhere((place < SHAPE_EDGE) | (place > 1.0 - SHAPE_EDGE)):
            shape = self.form.shapes[i]
            bound = shape.low if place[j, i] < 0.5 else shape.high
            found.append(f"{joints[j]}.{shape.name} is at its bound {bound:g}")
        return tuple(found)

    def _friction(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        scale, bounded = self.scale.ravel(), np.tile(self.form.nonnegative, len(self.scale))
        value = np.where(bounded, np.logaddexp(0.0, x), x)
        return scale * value, scale * np.where(bounded, expit(x), 1.0)

    def _shapes(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        n = len(self.scale)
        low = np.tile([s.low for s in self.form.shapes], n)
        width = np.tile([np.log(s.high / s.low) for s in self.form.shapes], n)
        place = expit(x)
        value = low * np.exp(width * place)
        return value, value * width * place * (1.0 - place)


def folding(base: BaseParameters) -> FloatArray:
    """(b, p) matrix that combines full parameters into base parameters."""
    fold = np.zeros((base.rank, len(base.independent) + len(base.dependent)))
    fold[np.arange(base.rank), base.independent] = 1.0
    fold[:, base.dependent] = base.combination
    return fold
