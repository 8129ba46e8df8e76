"""Columns of the friction library as C expressions.

Every group of `hil.estimators.friction_library` has its columns here as C expressions of what a
joint has at this sample: `v`, `speed` = |v|, `z3` (Dahl's state of three times the shortest
length), `tau` (torque through the gear) and `load` = |tau|, `peak03` (Stribeck's exponential, 0.3
as wide), `law025` (sign(v)·|v|^0.25), `sin4`, `cos4` (four times per motor turn).
"""

from __future__ import annotations

from collections.abc import Mapping

from hil.estimators import MULTIPLES, ORDERS

GROUPS: Mapping[str, tuple[str, ...]] = {
    "core": ("1.0", "v", "z1"),
    "load": ("z1 * load",),
    "stribeck": ("z1 * peak1",),
    "stribeck narrow": ("z1 * peak03",),
    "stribeck wide": ("z1 * peak3",),
    "stribeck load": ("z1 * peak1 * load",),
    "stribeck wide load": ("z1 * peak3 * load",),
    "stribeck memory": ("z10 * peak03",),
    "braking": ("fabs(z1) * tau",),
    "drive": ("tau * load",),
    **{f"memory {k:g}": (f"z{k:g}",) for k in MULTIPLES[1:]},
    **{f"memory {k:g} load": (f"z{k:g} * load",) for k in MULTIPLES[1:]},
    "speed p": ("law_p",),
    "speed 0.25": ("law025",),
    "speed 0.5": ("law05",),
    "speed 1.5": ("law15",),
    "speed 2": ("v * speed",),
    "speed p load": ("law_p * load",),
    "speed 1 load": ("v * load",),
    "speed 2 load": ("v * speed * load",),
    "asymmetry": ("speed",),
    "dry asymmetry": ("fabs(z1)",),
    "speed braking": ("speed * tau",),
    **{f"turn {k}": (f"jsin{k}", f"jcos{k}") for k in (1, 2)},
    **{f"turn {k} dry": (f"z1 * jsin{k}", f"z1 * jcos{k}") for k in (1, 2)},
    **{f"ripple {k}": (f"sin{k}", f"cos{k}") for k in ORDERS},
    **{f"ripple {k} slow": (f"slow * sin{k}", f"slow * cos{k}") for k in ORDERS},
    **{f"ripple {k} sign": (f"sense * sin{k}", f"sense * cos{k}") for k in ORDERS},
    **{
        f"ripple {k} slow sign": (f"slow * sense * sin{k}", f"slow * sense * cos{k}")
        for k in ORDERS
    },
    "temperature": ("z1 * warmth", "law_p * warmth"),
}
"""Group → its columns."""

PEAKS = {"peak03": 0.3, "peak1": 1.0, "peak3": 3.0}
LAWS = {"law025": 0.25, "law05": 0.5, "law15": 1.5}
SUMS = {2: (1, 1), 4: (2, 2), 8: (4, 4), 10: (8, 2), 12: (8, 4)}
"""Multiples of an angle as sums of two others: one sine and cosine per joint is enough."""
