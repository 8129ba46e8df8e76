"""What friction columns are made of: motion, transmitted torque, memory, temperature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from hil.core import FloatArray
from hil.estimators.friction.memory import dahl_slopes, dahl_states

MULTIPLES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Lengths of the friction states as multiples of the shortest: from microslip in the contacts to
the winding-up of a whole gear."""

RIPPLE_FADES_RAD_S = 0.3
"""A controller fights slow ripple with current; fast ripple the rotor's inertia swallows."""

REFERENCE_C = 30.0
"""Temperature at which columns of temperature vanish."""


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """The parameters of friction that are not linear, per joint.

    Attributes:
        length: (n,) shortest length of the friction state, x₀ [rad].
        stribeck: (n,) speed at which the Stribeck peak has fallen to 1/e [rad/s].
        power: (n,) exponent of the concave speed law sign(v)·|v|^p.
        turns: (n,) motor turns per joint turn; NaN where unknown.
    """

    length: FloatArray
    stribeck: FloatArray
    power: FloatArray
    turns: FloatArray

    def to_array(self) -> FloatArray:
        """(4, n) for the model file."""
        return np.stack([self.length, self.stribeck, self.power, self.turns])

    @staticmethod
    def from_array(values: FloatArray) -> Shapes:
        """Inverse of `to_array`."""
        return Shapes(*values)


@dataclass(eq=False)
class FrictionMotion:
    """One series, seen by the columns. All arrays are (N, n).

    Attributes:
        q: Position [rad].
        v: Velocity [rad/s].
        transmitted: Torque through the gear: rigid body and load, without friction [N·m].
        shapes: See there.
        steps: Way since the sample before [rad]; not needed with `given`.
        celsius: Joint temperature, None when it was not recorded.
        given: States by multiple where they are known already, as in a stream.
    """

    q: FloatArray
    v: FloatArray
    transmitted: FloatArray
    shapes: Shapes
    steps: FloatArray | None = None
    celsius: FloatArray | None = None
    given: Mapping[float, FloatArray] | None = None
    _states: dict[float, FloatArray] = field(default_factory=dict, repr=False)

    def state(self, multiple: float = 1.0) -> FloatArray:
        """Dahl's state with `multiple` times the shortest length."""
        if self.given is not None:
            return self.given[multiple]
        if multiple not in self._states:
            assert self.steps is not None
            self._states[multiple] = dahl_states(self.steps, multiple * self.shapes.length)
        return self._states[multiple]

    def state_slope(self) -> FloatArray:
        """Derivative of `state()` by the logarithm of its length."""
        assert self.steps is not None
        return dahl_slopes(self.steps, self.shapes.length, self.state())

    @cached_property
    def speed(self) -> FloatArray:
        """|v|."""
        return np.abs(self.v)

    @cached_property
    def load(self) -> FloatArray:
        """|transmitted torque|."""
        return np.abs(self.transmitted)

    @cached_property
    def z(self) -> FloatArray:
        """The shortest state."""
        return self.state()

    def peak(self, width: float = 1.0) -> FloatArray:
        """Stribeck's exp(−|v|/vs), vs `width` times as wide."""
        return np.asarray(np.exp(-self.speed / (width * self.shapes.stribeck)))

    def law(self, power: FloatArray | float) -> FloatArray:
        """sign(v)·|v|^power."""
        return np.asarray(np.sign(self.v) * self.speed**power)

    @cached_property
    def slow(self) -> FloatArray:
        """How much of the ripple the controller answers at this speed, 1 at rest."""
        return np.asarray(np.exp(-self.speed / RIPPLE_FADES_RAD_S))

    @cached_property
    def direction(self) -> FloatArray:
        """The sign of the motion, smooth through 0."""
        return np.asarray(np.tanh(self.v / 0.01))

    @cached_property
    def warmth(self) -> FloatArray:
        """Temperature over the reference [K]; 0 where unknown."""
        if self.celsius is None:
            return np.zeros_like(self.v)
        return np.nan_to_num(self.celsius - REFERENCE_C)
