"""How close a program has to come to its model, by the precision it computes in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.export.agreement import scale_of
from hil.export.golden import Golden
from hil.export.lagrangian_terms import NetworkFriction
from hil.export.program import Program

DOUBLE, SINGLE = 1e-9, 1e-5
"""Largest difference as a share of each joint's largest effort."""

NETWORK = 1e-5
"""Of a residual network, as a share of the largest that it adds to the joint."""

UNHEARD = 1e-4
"""A residual that never comes up to this share of the effort counts as having it."""


@dataclass(frozen=True, slots=True, eq=False)
class Closeness:
    """What differences are judged by.

    Attributes:
        effort: (n,) most that efforts without the residual may differ.
        residual: (n,) most that the residual may.
        largest: (n,) largest effort.
    """

    effort: FloatArray
    residual: FloatArray
    largest: FloatArray


def closeness(program: Program, golden: Golden) -> Closeness:
    """Of a program that is to say what `golden` says, in effort units."""
    largest = scale_of(golden.bare, golden.loaded)
    own = UNHEARD * largest
    if golden.residuals is not None:
        own = np.maximum(own, np.abs(golden.residuals).max(axis=(0, 1)))
    return Closeness(precision(program) * largest, NETWORK * own, largest)


def precision(program: Program) -> float:
    """`DOUBLE`, or `SINGLE` where a network stands for the rigid body or for friction."""
    kinds = [] if program.lagrangian is None else [program.lagrangian.kind]
    if isinstance(program.friction, NetworkFriction):
        kinds.append(program.friction.kind)
    return SINGLE if "float" in kinds else DOUBLE
