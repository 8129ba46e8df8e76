"""Friction that a few numbers per joint shape: Stribeck's peak, a power of the speed, memory.

    friction = d·[Fc + (Fs − Fc)·exp(−(u/vs)^δ) + g·|τ|] + p·Fp·u^α + Fv·q̇ + offset
             + z₁₀·(m + mg·|τ|)

with u the speed, d the direction, p the direction of the power and τ the torque through the gear.
`rigid-diffnea` and `lagrangian` have it in forms that differ in which terms are there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.estimators import FORMS, LEAST_SPEED, RigidDiffnea
from hil.export.program import PlainFriction


@dataclass(frozen=True, slots=True, eq=False)
class ShapedFriction:
    """The law of all joints; coefficients are 0 where a term is not there.

    Attributes:
        coulomb, static: Fc, Fs (n,) [N·m].
        stribeck_speed: vs (n,) [rad/s].
        stribeck_exponent: δ (n,).
        power: Fp (n,) [N·m].
        exponent: α (n,).
        viscous: Fv (n,) [N·m·s/rad].
        offset: (n,) [N·m].
        sign_width: Of tanh(q̇/width) [rad/s]; 0 for the hard sign.
        least_speed: Speeds count as this at least [rad/s].
        more_speed: Added to speeds before that [rad/s]; one of both is above 0.
        length: (n,) in which Dahl's state comes round, which is the direction then [rad]; None for
            the sign, without memory.
        power_remembers: The direction of the power is Dahl's state too, not the sign.
        load: g (n,).
        far, far_load: m [N·m] and mg (n,), of a state with ten times the length.
    """

    coulomb: FloatArray
    static: FloatArray
    stribeck_speed: FloatArray
    stribeck_exponent: FloatArray
    power: FloatArray
    exponent: FloatArray
    viscous: FloatArray
    offset: FloatArray
    sign_width: float
    least_speed: float
    more_speed: float
    load: FloatArray
    far: FloatArray
    far_load: FloatArray
    length: FloatArray | None = None
    power_remembers: bool = False


def shaped_of(model: RigidDiffnea) -> PlainFriction | ShapedFriction:
    """Friction of a fitted `rigid-diffnea`."""
    n, form = model.robot_.n, FORMS[model.friction]
    own = model.coefficients_[len(model.gear_rigid_) :]
    count = len(form.terms)
    values = dict(zip(form.terms, own[: n * count].reshape(n, count).T, strict=True))
    names = [shape.name for shape in form.shapes]
    shapes = dict(zip(names, own[n * count :].reshape(n, -1).T, strict=True))
    none, one = np.zeros(n), np.ones(n)
    width = model.sign_width
    if not shapes:
        coulomb, viscous, offset = (values[term] for term in form.terms)
        return PlainFriction(coulomb, viscous, offset, width, one, width or 1.0)
    # Without memory the exponent replaces what is viscous; with it the power is a term of its own.
    powered = "speed_exponent" in shapes and "speed" not in values
    return ShapedFriction(
        coulomb=values["coulomb"],
        static=values["static"],
        stribeck_speed=shapes["stribeck_velocity"],
        stribeck_exponent=shapes.get("stribeck_exponent", one),
        power=values["viscous"] if powered else values.get("speed", none),
        exponent=shapes.get("speed_exponent", one),
        viscous=none if powered else values["viscous"],
        offset=values["offset"],
        sign_width=width,
        least_speed=0.0,
        more_speed=LEAST_SPEED,
        load=values.get("load", none),
        far=values.get("memory", none),
        far_load=values.get("memory_load", none),
        length=shapes.get("dahl_length"),
    )
