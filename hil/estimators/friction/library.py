"""The friction library: named groups of columns that are linear in their coefficients.

Every group is a piece of physics that a robot may show or not; which of them a joint gets is for
its data to say (`selection`). z is Dahl's state in place of sign(v), τ the torque through the gear,
vs, p and x₀ the shapes:

- `core`: offset, viscous v and Coulomb friction z;
- `load`: z·|τ|, the gear's efficiency (6–8 % on UR arms);
- `stribeck…`: z·exp(−|v|/vs), and with load; PINN paper eq. 15–18 with an exponent of 1;
- `memory …`: states with longer lengths, and with load;
- `speed …`: sign(v)·|v|^p; `asymmetry`, `braking`: other friction one way, or as the load drives;
- `drive`: current that grows faster than torque; `turn …`: what repeats with the joint's turn;
- `ripple k`: k times per motor turn, evenly, fading with speed, and with the sign of the motion;
- `temperature`: Coulomb and viscous friction per kelvin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hil.core import FloatArray
from hil.estimators.friction.motion import MULTIPLES, FrictionMotion

Columns = Callable[[FrictionMotion], Sequence[FloatArray]]

CORE = "core"
LADDER = (
    ("speed p",),
    ("load", "stribeck"),
    ("memory 3", "memory 30", "speed 0.25"),
    ("speed 1 load", "speed p load", "speed braking", "braking"),
    ("stribeck narrow", "stribeck wide"),
)
"""What each step up adds to a joint's friction. Chosen on four UR10e trajectories, each left out in
turn: broad steps that all joints share predict new trajectories better than column by column."""

ORDERS = (1, 2, 4, 8, 10, 12)
"""Ripple periods per motor turn: gear teeth (1, 2) and the poles and slots of servo motors."""


def groups(*, ripple: bool, temperature: bool) -> dict[str, Columns]:
    """All groups that a robot can have.

    Args:
        ripple: Motor turns per joint turn are known.
        temperature: Joint temperatures were recorded.
    """
    found = {**_DRY, **_MEMORY, **_SPEED, **_TURN}
    if ripple:
        found |= {name: columns for order in ORDERS for name, columns in _ripples(order).items()}
    if temperature:
        found["temperature"] = lambda m: (m.z * m.warmth, m.law(m.shapes.power) * m.warmth)
    return found


def rungs(*, ripple: bool, temperature: bool) -> list[tuple[str, ...]]:
    """Groups from the fewest to the most, each list holding the one before; see `groups`."""
    steps = list(LADDER)
    if ripple:
        steps.append(tuple(f"ripple {k}{how}" for k in ORDERS for how in ("", " slow", " sign")))
    if temperature:
        steps.append(("temperature",))
    taken: tuple[str, ...] = (CORE,)
    return [taken, *(taken := (*taken, *step) for step in steps)]


LOADED = frozenset(
    {"load", "stribeck load", "stribeck wide load", "braking", "drive", "speed p load",
     "speed 1 load", "speed 2 load", "speed braking"}
    | {f"memory {k:g} load" for k in MULTIPLES[1:]}
)  # fmt: skip
"""Groups whose columns grow with the torque through the gear."""

LEAST_LOAD = 0.2
"""Torque through a gear, as a share of what is left to friction (root mean squares), below which
the joint gets none of `LOADED`: fitted to next to no load, they would be anything under a real
one. A UR10e's wrist 2 and 3 transmit a tenth and less."""


def column_names(group: str, count: int) -> tuple[str, ...]:
    """Names of a group's columns."""
    if group == CORE:
        return ("offset", "viscous", "coulomb")
    return (group,) if count == 1 else tuple(f"{group}.{i + 1}" for i in range(count))


def _core(m: FrictionMotion) -> Sequence[FloatArray]:
    return np.ones_like(m.v), m.v, m.z


_DRY: Mapping[str, Columns] = {
    CORE: _core,
    "load": lambda m: (m.z * m.load,),
    "stribeck": lambda m: (m.z * m.peak(),),
    "stribeck narrow": lambda m: (m.z * m.peak(0.3),),
    "stribeck wide": lambda m: (m.z * m.peak(3.0),),
    "stribeck load": lambda m: (m.z * m.peak() * m.load,),
    "stribeck wide load": lambda m: (m.z * m.peak(3.0) * m.load,),
    "stribeck memory": lambda m: (m.state(10.0) * m.peak(0.3),),
    "braking": lambda m: (np.abs(m.z) * m.transmitted,),
    "drive": lambda m: (m.transmitted * m.load,),
}


def _memory(multiple: float) -> dict[str, Columns]:
    name = f"memory {multiple:g}"
    return {
        name: lambda m: (m.state(multiple),),
        f"{name} load": lambda m: (m.state(multiple) * m.load,),
    }


_MEMORY: Mapping[str, Columns] = {
    name: columns for k in MULTIPLES[1:] for name, columns in _memory(k).items()
}

_SPEED: Mapping[str, Columns] = {
    "speed p": lambda m: (m.law(m.shapes.power),),
    "speed 0.25": lambda m: (m.law(0.25),),
    "speed 0.5": lambda m: (m.law(0.5),),
    "speed 1.5": lambda m: (m.law(1.5),),
    "speed 2": lambda m: (m.law(2.0),),
    "speed p load": lambda m: (m.law(m.shapes.power) * m.load,),
    "speed 1 load": lambda m: (m.v * m.load,),
    "speed 2 load": lambda m: (m.law(2.0) * m.load,),
    "asymmetry": lambda m: (m.speed,),
    "dry asymmetry": lambda m: (np.abs(m.z),),
    "speed braking": lambda m: (m.speed * m.transmitted,),
}


def _turn(order: int) -> dict[str, Columns]:
    def waves(m: FrictionMotion) -> tuple[FloatArray, FloatArray]:
        return np.sin(order * m.q), np.cos(order * m.q)

    return {
        f"turn {order}": waves,
        f"turn {order} dry": lambda m: tuple(m.z * wave for wave in waves(m)),
    }


_TURN: Mapping[str, Columns] = {
    name: columns for order in (1, 2) for name, columns in _turn(order).items()
}


def _ripples(order: int) -> dict[str, Columns]:
    def waves(m: FrictionMotion) -> tuple[FloatArray, FloatArray]:
        angle = order * np.nan_to_num(m.shapes.turns) * m.q
        return np.sin(angle), np.cos(angle)

    def times(factor: Callable[[FrictionMotion], FloatArray]) -> Columns:
        return lambda m: tuple(factor(m) * wave for wave in waves(m))

    return {
        f"ripple {order}": waves,
        f"ripple {order} slow": times(lambda m: m.slow),
        f"ripple {order} sign": times(lambda m: m.direction),
        f"ripple {order} slow sign": times(lambda m: m.slow * m.direction),
    }
