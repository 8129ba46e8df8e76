"""What a controller computes every cycle, free of the estimator that found it.

    torque = rigid body and load + friction, or Lagrangian network + load + friction
    effort = torque / scale + correction

A program knows joints, bodies and friction in plain arrays, so that C, ONNX or anything else can be
written from it. Bodies need not be able to exist: they are one set that has the base parameters of
the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray
from hil.dynamics import JointGeometry
from hil.estimators import FrictionLaw
from hil.networks import Correction

if TYPE_CHECKING:
    from hil.export.lagrangian_terms import LagrangianTerms, NetworkFriction
    from hil.export.shaped import ShapedFriction

BODY = 10
"""Parameters of a body in `hil.dynamics.inertial`'s order; the rotor's inertia comes behind."""


@dataclass(frozen=True, slots=True, eq=False)
class PlainFriction:
    """Coulomb and viscous friction with a smooth sign, and a constant.

    Attributes:
        coulomb: (n,) [N·m].
        viscous: (n,) [N·m·s/rad].
        offset: (n,) [N·m].
        sign_width: Of tanh(qd/width) [rad/s]; 0 for the hard sign.
        exponent: (n,) of the viscous part, see `hil.estimators.friction_curve.power_of_speed`.
        power_width: Of that [rad/s].
    """

    coulomb: FloatArray
    viscous: FloatArray
    offset: FloatArray
    sign_width: float
    exponent: FloatArray
    power_width: float


@dataclass(frozen=True, slots=True, eq=False)
class Program:
    """A model as arithmetic.

    Attributes:
        estimator: What found it.
        joint_names: n of them.
        effort_kind: `current` or `torque`: what comes out.
        geometry: Where the joints are.
        gravity: (3,) in the base frame [m/s²].
        flange: (4, 4) pose of the flange in the last joint's frame; loads are told in the flange's.
        rigid: (n, 11) per link: a body in the joint's frame, and the rotor's inertia. Zeros where
            a Lagrangian network stands for them.
        gears: (n, 11) the same for the torque that the gears transmit, on which friction depends.
        friction: With or without memory.
        scale: (n,) torque per unit of effort.
        correction: Of a residual network, in effort units.
        lagrangian: Network that takes the place of the rigid body; loads stay bodies.
        coupling: (n, n) T of joints = T · motors where a motor moves more than one joint, else
            None. Samples and efforts are the motors' then: bodies and load hold Tᵀ times what the
            joints at T q, T q̇, T q̈ hold; rotors, friction, networks and scale are the motors'.
    """

    estimator: str
    joint_names: tuple[str, ...]
    effort_kind: str
    geometry: JointGeometry
    gravity: FloatArray
    flange: FloatArray
    rigid: FloatArray
    gears: FloatArray
    friction: PlainFriction | FrictionLaw | ShapedFriction | NetworkFriction
    scale: FloatArray
    correction: Correction | None = None
    lagrangian: LagrangianTerms | None = None
    coupling: FloatArray | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def remembers(self) -> bool:
        """Whether what comes out depends on samples before."""
        carried = getattr(self.friction, "length", None) is not None
        return carried or isinstance(self.friction, FrictionLaw) or self.correction is not None


def bodies(full: FloatArray, n: int) -> FloatArray:
    """(n, 11) per link from full parameters (11n,) in the order of the regressor's columns."""
    return np.column_stack([full[: BODY * n].reshape(n, BODY), full[BODY * n :]])


def terms_of(law: FrictionLaw) -> tuple[Mapping[str, FloatArray], ...]:
    """Per joint, its groups' coefficients by the name of the group."""
    found = []
    for names, flat in zip(law.chosen, law.coefficients, strict=True):
        counts = [law.count(name) for name in names]
        pieces = np.split(flat, np.cumsum(counts)[:-1])
        found.append(dict(zip(names, pieces, strict=True)))
    return tuple(found)
