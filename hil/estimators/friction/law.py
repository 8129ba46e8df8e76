"""Friction as it was found: groups and coefficients per joint, ready to predict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hil.core import FloatArray
from hil.estimators.friction.library import Columns, column_names, groups
from hil.estimators.friction.motion import MULTIPLES, FrictionMotion, Shapes

PARTS = {"ripple": "ripple", "drive": "drive"}
"""First word of a group → the part of the effort it belongs to; all others are friction."""

_TURN = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
"""Angles of a joint at which its friction at rest is looked at [rad]."""


@dataclass(frozen=True, eq=False)
class FrictionLaw:
    """What friction, ripple and drive add to each joint.

    Attributes:
        chosen: Groups per joint, in the order of their coefficients.
        coefficients: Per joint, of its groups' columns.
        shapes: The parameters that are not linear.
        celsius: (n,) usual joint temperature of the training, for where it is not known.
    """

    chosen: tuple[tuple[str, ...], ...]
    coefficients: tuple[FloatArray, ...]
    shapes: Shapes
    celsius: FloatArray | None = None

    @classmethod
    def from_flat(
        cls,
        chosen: tuple[tuple[str, ...], ...],
        flat: FloatArray,
        shapes: Shapes,
        celsius: FloatArray | None = None,
    ) -> FrictionLaw:
        """From all coefficients behind each other, joint by joint.

        Raises:
            KeyError: There is no such group.
            ValueError: There are more or fewer coefficients or joints than the groups have.
        """
        law, n = cls(chosen, (), shapes), len(chosen)
        counts = [sum(law.count(name) for name in names) for names in chosen]
        if flat.shape != (sum(counts),) or shapes.length.shape != (n,):
            raise ValueError(
                f"friction: {flat.size} coefficients and shapes of {shapes.length.size} joints "
                f"for {sum(counts)} columns and {n} joints"
            )
        return cls(chosen, tuple(np.split(flat, np.cumsum(counts)[:-1])), shapes, celsius)

    def torques(self, motion: FrictionMotion) -> dict[str, FloatArray]:
        """Parts `friction`, `ripple` and `drive`, each (N, n) [N·m]; only those there are."""
        found: dict[str, FloatArray] = {"friction": np.zeros_like(motion.v)}
        for name, weights in self._weights.items():
            part = PARTS.get(name.split()[0], "friction")
            torque = found.setdefault(part, np.zeros_like(motion.v))
            for column, weight in zip(self._library[name](motion), weights, strict=True):
                torque += column * weight
        return found

    def break_away(self) -> FloatArray:
        """Return the friction (n,) that an unloaded joint at rest holds before it slides [N·m].

        At rest the speed laws vanish, and what is left is carried by the states. A joint slides
        once all of them are wound up; forth and back are averaged, which leaves out offset and
        asymmetry. Friction that changes with the angle of a joint counts where it is least.
        """
        q = np.broadcast_to(_TURN[:, None], (len(_TURN), len(self.chosen)))
        still = np.zeros_like(q)
        celsius = None if self.celsius is None else np.broadcast_to(self.celsius, q.shape)

        def wound_up(sign: float) -> FloatArray:
            states = dict.fromkeys(MULTIPLES, np.full_like(q, sign))
            rest = FrictionMotion(q, still, still, self.shapes, celsius=celsius, given=states)
            return self.torques(rest)["friction"]

        level: FloatArray = 0.5 * (wound_up(1.0) - wound_up(-1.0)).min(axis=0)
        return np.maximum(level, 0.0)

    @property
    def multiples(self) -> tuple[float, ...]:
        """Lengths of the states that a stream must carry, as multiples of the shortest."""
        return MULTIPLES

    def parameter_names(self, joint_names: Sequence[str]) -> tuple[str, ...]:
        """Names of all coefficients, joint by joint."""
        return tuple(
            f"{joint}.{column}"
            for joint, names in zip(joint_names, self.chosen, strict=True)
            for name in names
            for column in column_names(name, self.count(name))
        )

    @cached_property
    def _library(self) -> Mapping[str, Columns]:
        return groups(ripple=True, temperature=True)

    @cached_property
    def _weights(self) -> dict[str, list[FloatArray]]:
        """Per group, for each of its columns the coefficient of every joint; 0 without it."""
        n, found = len(self.chosen), dict[str, list[FloatArray]]()
        for j, names in enumerate(self.chosen):
            at = 0
            for name in names:
                count = self.count(name)
                weights = found.setdefault(name, [np.zeros(n) for _ in range(count)])
                for i in range(count):
                    weights[i][j] = self.coefficients[j][at + i]
                at += count
        return found

    def count(self, name: str) -> int:
        """How many columns, and so coefficients, a group has.

        Raises:
            KeyError: There is no such group.
        """
        probe = np.zeros((1, len(self.chosen)))
        states = dict.fromkeys(MULTIPLES, probe)
        motion = FrictionMotion(probe, probe, probe, self.shapes, given=states)
        return len(self._library[name](motion))
