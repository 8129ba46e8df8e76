"""Gravity at standstill and one level of dry friction per joint: the baseline with a direction.

i·K = g(q) + offset + Fc·sign(approach). Most of what gravity alone leaves unexplained at rest is
this; what is still left is the subject of `static-hysteresis`.
"""

from __future__ import annotations

from typing import ClassVar

from hil.core import FloatArray
from hil.estimators.parameters import number
from hil.estimators.rest_friction import Rest, coulomb_terms
from hil.estimators.static_friction import StaticFriction


class StaticCoulomb(StaticFriction):
    """Gravity, offset and Coulomb friction with the sign of the approach, joint by joint.

    Args:
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.
    """

    estimator: ClassVar[str] = "static-coulomb"

    def __init__(self, *, rest_speed: float = 0.01) -> None:
        self.rest_speed = number("rest_speed", rest_speed, above=0.0)

    def _terms(self, rest: Rest) -> dict[str, FloatArray]:
        return coulomb_terms(rest)
