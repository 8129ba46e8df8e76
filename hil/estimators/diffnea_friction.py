"""Friction laws of DiffNEA: regressor columns with a few nonlinear shape parameters.

The friction of every joint is C(motion; s)·c with coefficients c and bounded shapes s. Coefficients
of dissipative terms are non-negative. All derivatives with respect to the shapes are exact. In laws
without memory, sgn denotes tanh(q̇/width). In laws with memory, z is Dahl's state
(`hil.estimators.friction_memory`) and τ the torque through the gear. `FORMS` contains the laws by
name; `ArmMotion` and `JointMotion` contain their inputs.

The fit of the shapes evaluates the columns many times. `BendingRows` computes all constant products
once: for each joint, the Gram matrix of [Y | C | ∂C/∂s·c | τ] is assembled from YᵀY, Yᵀτ, τᵀτ and
the products with the few variable columns. The Cholesky factor of this matrix is a small system
with the same least-squares solution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Dataset
from hil.estimators.friction_memory import Pieces, path_steps
from hil.estimators.least_squares import System

LEAST_SPEED = 1e-9
"""Offset added to |q̇| before a power or a logarithm is computed [rad/s]."""

LONG = 10.0
"""Length of the second friction state, as a multiple of the length of the first."""


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """Motion of one joint, all series in sequence; arrays have the shape (N,).

    Attributes:
        qd: Velocity [rad/s].
        sign: Smoothed sign of the velocity.
        transmitted: Torque through the gear from rigid body and payload, without friction torque
            [N·m].
        pieces: Pieces of the path between reversals; None if states are passed, or if the law has
            no memory.
        given: Friction states, by multiple of the shortest length, that a stream passes.
    """

    qd: FloatArray
    sign: FloatArray
    transmitted: FloatArray
    pieces: Pieces | None = None
    given: Mapping[float, FloatArray] | None = None

    def every(self, k: int) -> JointMotion:
        """Return every k-th sample, with the friction states of all samples."""
        columns = (self.qd, self.sign, self.transmitted)
        qd, sign, transmitted = (np.ascontiguousarray(column[::k]) for column in columns)
        return JointMotion(qd, sign, transmitted, self.pieces and self.pieces.every(k))

    def state(self, length: float, multiple: float) -> tuple[FloatArray, FloatArray]:
        """Return Dahl's state for `multiple` times the length [rad], and its derivative.

        The derivative of the state is taken with respect to the length.
        """
        if self.given is not None:
            return self.given[multiple], np.zeros_like(self.qd)
        assert self.pieces is not None
        state, by_log = self.pieces.state(multiple * length)
        return state, by_log / length


@dataclass(frozen=True, slots=True, eq=False)
class ArmMotion:
    """Motion of all joints; arrays have the shape (N, n) and the same meaning as in `JointMotion`.

    Attributes:
        steps: Joint displacement since the previous sample [rad].
        series: Row range of every series.
    """

    qd: FloatArray
    sign: FloatArray
    transmitted: FloatArray
    steps: FloatArray
    series: tuple[slice, ...] = ()
    given: Mapping[float, FloatArray] | None = None

    @classmethod
    def of(cls, data: Dataset, transmitted: FloatArray, width: float) -> ArmMotion:
        """Return the motion of a prepared dataset; `width` [rad/s] smooths the sign."""
        qd = data["qd_f"]
        series = tuple(rows for _, rows in data.slices() if rows.stop > rows.start)
        return cls(qd, sign_of(qd, width), transmitted, path_steps(data), series)

    def joint(self, j: int) -> JointMotion:
        """Return the motion of joint j."""
        columns = (self.qd, self.sign, self.transmitted, self.steps)
        qd, sign, transmitted, steps = (np.ascontiguousarray(column[:, j]) for column in columns)
        if self.given is not None:
            given = {k: state[:, j] for k, state in self.given.items()}
            return JointMotion(qd, sign, transmitted, None, given)
        return JointMotion(qd, sign, transmitted, Pieces.of(steps, self.series))


def sign_of(qd: FloatArray, width: float) -> FloatArray:
    """Return tanh(q̇/width), or the discontinuous sign if the width is 0."""
    return np.tanh(qd / width) if width > 0 else np.sign(qd)


@dataclass(frozen=True, slots=True)
class Shape:
    """Nonlinear parameter of a friction law.

    Attributes:
        name: Name of the parameter.
        start: Initial value of the fit.
        low, high: Lower and upper bound; the fit uses the logarithm of the parameter between them.
    """

    name: str
    start: float
    low: float
    high: float


Columns = Callable[[JointMotion, FloatArray], tuple[FloatArray, FloatArray]]
"""Function from a motion of N samples and shapes s (S,) to C (N, k) and ∂C/∂s (N, k, S)."""


@dataclass(frozen=True, slots=True)
class Form:
    """Friction law with linear coefficients and nonlinear shapes.

    Attributes:
        terms: Names of the k coefficients per joint.
        signs: (k,) mask of the coefficients that must be non-negative.
        shapes: Nonlinear parameters; empty for a linear law.
        columns: Function that evaluates the columns.
        multiples: Lengths of the friction states, as multiples of the first shape; empty for a law
            without memory.
    """

    terms: tuple[str, ...]
    signs: tuple[bool, ...]
    shapes: tuple[Shape, ...]
    columns: Columns
    multiples: tuple[float, ...] = ()

    @property
    def nonnegative(self) -> BoolArray:
        """Mask (k,) of the coefficients that must be non-negative."""
        return np.array(self.signs)

    def evaluate(self, motion: ArmMotion, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return C (N, n, k) and ∂C/∂s (N, n, k, S) of all joints with shapes (n, S)."""
        found = [self.columns(motion.joint(j), shape) for j, shape in enumerate(shapes)]
        columns, slopes = zip(*found, strict=True)
        return np.stack(columns, axis=1), np.stack(slopes, axis=1)


def spread(columns: FloatArray) -> FloatArray:
    """Return the sample-major regressor (N·n, n·k) of the columns (N, n, k) of all joints.

    Each friction column affects only the torque of its own joint.
    """
    samples, joints, k = columns.shape
    out = np.zeros((samples, joints, joints, k))
    out[:, np.arange(joints), np.arange(joints)] = columns
    return out.reshape(samples * joints, joints * k)


_TERMS, _SIGNS = ("coulomb", "static", "viscous", "offset"), (True, True, True, False)

_STRIBECK = (
    Shape("stribeck_velocity", 0.1, 0.01, 1.0),
    Shape("stribeck_exponent", 1.0, 0.5, 2.5),
)

_EXPONENT = Shape("speed_exponent", 0.8, 0.2, 1.5)


def _coulomb_viscous(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    qd = motion.qd
    return np.stack([motion.sign, qd, np.ones_like(qd)], axis=-1), np.zeros((len(qd), 3, 0))


def _stribeck(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    qd, sign, (speed, exponent) = motion.qd, motion.sign, shape
    z = (np.abs(qd) + LEAST_SPEED) / speed
    power = z**exponent
    peak = np.exp(-power)
    C = np.stack([sign * (1.0 - peak), sign * peak, qd, np.ones_like(qd)], axis=-1)
    slope = np.zeros((len(qd), 4, 2))
    slope[:, 1, 0] = sign * peak * power * exponent / speed
    slope[:, 1, 1] = -sign * peak * power * np.log(z)
    slope[:, 0] = -slope[:, 1]
    return C, slope


def _stribeck_power(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    C, inner = _stribeck(motion, shape[:2])
    C[:, 2], by_exponent = _power(motion, shape[2])
    slope = np.zeros((len(C), 4, 3))
    slope[:, :, :2] = inner
    slope[:, 2, 2] = by_exponent
    return C, slope


def _memory(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    length, speed, exponent = shape
    z, dz = motion.state(length, 1.0)
    far, dfar = motion.state(length, LONG)
    load, ratio = np.abs(motion.transmitted), np.abs(motion.qd) / speed
    peak = np.exp(-ratio)
    law, by_exponent = _power(motion, exponent)
    one = np.ones_like(z)
    C = np.stack([z * (1.0 - peak), z * peak, z * load, law, motion.qd, one, far, far * load])
    slope = np.zeros((3, *C.shape))
    slope[0, [0, 1, 2, 6, 7]] = [dz * (1.0 - peak), dz * peak, dz * load, dfar, dfar * load]
    slope[1, 1] = z * peak * ratio / speed
    slope[1, 0] = -slope[1, 1]
    slope[2, 3] = by_exponent
    return C.T, slope.T.copy()


def _power(motion: JointMotion, exponent: float) -> tuple[FloatArray, FloatArray]:
    """Return sgn·|q̇|^α and its derivative with respect to α."""
    speed = np.abs(motion.qd) + LEAST_SPEED
    law = motion.sign * speed**exponent
    return law, law * np.log(speed)


_REMEMBERING = Form(
    ("coulomb", "static", "load", "speed", "viscous", "offset", "memory", "memory_load"),
    (True, True, True, True, True, False, False, False),
    (
        Shape("dahl_length", 2e-4, 3e-5, 3e-3),
        Shape("stribeck_velocity", 0.1, 0.02, 0.5),
        Shape("speed_exponent", 0.35, 0.15, 0.85),
    ),
    _memory,
    (1.0, LONG),
)

FORMS = {
    "coulomb-viscous": Form(
        ("coulomb", "viscous", "offset"), (True, True, False), (), _coulomb_viscous
    ),
    "stribeck": Form(_TERMS, _SIGNS, _STRIBECK, _stribeck),
    "stribeck-power": Form(_TERMS, _SIGNS, (*_STRIBECK, _EXPONENT), _stribeck_power),
    "memory": _REMEMBERING,
}
"""Friction laws by the name that the setting `friction` accepts.

The law `coulomb-viscous` has the terms Fc, Fv and offset. The law `stribeck` is [Fc + (Fs − Fc)
exp(−|q̇/vs|^δ)] sgn + Fv q̇ + offset. The law `stribeck-power` has the term Fv |q̇|^α sgn instead
of Fv q̇ (PINN paper eq. 15–18). The law `memory` is [Fc + (Fs − Fc) exp(−|q̇/vs|) + g |τ|] z + Fp
|q̇|^α sgn + Fv q̇ + offset, plus a state z₁₀ of ten times the length, alone and times |τ|.
"""

JITTER = 1e-13
"""Relative increase of the diagonal of a Gram matrix, which keeps the matrix regular.

Columns may coincide, for example the columns of shapes that have no effect.
"""


class BendingRows:
    """Rows kept in memory for repeated evaluation of the friction columns.

    Args:
        base: (N, n, b) base regressor.
        target: (N, n) torques [N·m].
        motion: Motion of all rows, because friction with memory depends on all of them.
        form: Friction law.
        every: Down-sampling factor; `base` and `target` contain only every `every`-th row.
    """

    def __init__(
        self, base: FloatArray, target: FloatArray, motion: ArmMotion, form: Form, every: int = 1
    ) -> None:
        self._form = form
        self._n, self._b = target.shape[1], base.shape[2]
        fixed = [np.column_stack([base[:, j], target[:, j]]) for j in range(self._n)]
        self._fixed = fixed
        self._fixed_gram = [block.T @ block for block in fixed]
        self._motion = [motion.joint(j).every(every) for j in range(self._n)]

    def __call__(self, values: FloatArray) -> System:
        """Return the system at the parameter values (b + nk + ns,), with one column per value."""
        k, s = len(self._form.terms), len(self._form.shapes)
        c, shapes = np.split(values[self._b :], [self._n * k])
        c, shapes = c.reshape(self._n, k), shapes.reshape(self._n, s)
        blocks = [self._joint(j, c[j], shapes[j]) for j in range(self._n)]
        joint: IntArray = np.repeat(np.arange(self._n), [len(block) for block in blocks])
        X = np.zeros((len(joint), len(values)))
        for j, block in enumerate(blocks):
            rows = joint == j
            X[rows, : self._b] = block[:, : self._b]
            own = self._b + j * k
            X[rows, own : own + k] = block[:, self._b + 1 : self._b + 1 + k]
            bent = self._b + self._n * k + j * s
            X[rows, bent : bent + s] = block[:, self._b + 1 + k :]
        return X, np.concatenate([block[:, self._b] for block in blocks]), joint

    def deviation(self, values: FloatArray) -> FloatArray:
        """Return (n,) the root mean square of the residual of each joint at the values [N·m]."""
        X, y, joint = self(values)
        linear = self._b + self._n * len(self._form.terms)
        squares = np.bincount(joint, (y - X[:, :linear] @ values[:linear]) ** 2)
        return np.asarray(np.sqrt(squares / len(self._fixed[0])))

    def _joint(self, j: int, c: FloatArray, shape: FloatArray) -> FloatArray:
        """Return the (m, m) triangular factor of [Y | τ | C | ∂C/∂s·c] of a joint."""
        C, slope = self._form.columns(self._motion[j], shape)
        bent = np.column_stack([C, np.einsum("Nks,k->Ns", slope, c)])
        across = self._fixed[j].T @ bent
        gram = np.block([[self._fixed_gram[j], across], [across.T, bent.T @ bent]])
        length = np.sqrt(np.diag(gram))
        length[length == 0] = 1.0
        scaled = gram / np.outer(length, length)
        scaled[np.diag_indices_from(scaled)] += JITTER
        upper: FloatArray = np.linalg.cholesky(scaled).T * length
        return upper
