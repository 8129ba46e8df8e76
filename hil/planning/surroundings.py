"""The collision model of a station's robot with the largest payload of an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from hil.arms import ArmDescription, Capsule, Payload
from hil.core import FloatArray
from hil.dynamics import Box, CollisionModel, Environment, Plane, payload_capsule
from hil.spec import Surroundings

BodySize = tuple[float, float]
"""Length and radius along the flange axis [m]."""


def collision_model(
    arm: ArmDescription,
    surroundings: Surroundings,
    loads: Sequence[tuple[Payload, BodySize | None]],
) -> CollisionModel:
    """Distances of the arm to itself, its surroundings and a body that holds every load.

    One body for all loads lets every load see the same program. Planning, preflight and interlocks
    ask for the same model: it is built once and, as nothing in it changes, shared.
    """
    capsules = [body for load, size in loads if (body := _capsule(load, size, arm.n_joints))]
    return _built(arm, _environment(surroundings), envelope(capsules) if capsules else None)


@lru_cache(maxsize=16)
def _built(arm: ArmDescription, around: Environment, payload: Capsule | None) -> CollisionModel:
    return CollisionModel(arm, around, payload)


def envelope(capsules: Sequence[Capsule]) -> Capsule:
    """One capsule that holds all of several that begin at the same point.

    It takes the longest axis. Every other axis strays from it no further than its own end does,
    distance to a convex set being convex.
    """
    ends = [np.array(capsule.b) for capsule in capsules]
    longest = max(ends, key=lambda end: float(end @ end))
    radius = max(
        capsule.radius + _off_axis(end, longest)
        for capsule, end in zip(capsules, ends, strict=True)
    )
    x, y, z = (float(c) for c in longest)
    return Capsule(capsules[0].link, (0.0, 0.0, 0.0), (x, y, z), radius)


def _off_axis(point: FloatArray, end: FloatArray) -> float:
    """Distance of `point` to the segment from the origin to `end`."""
    squared = float(end @ end)
    along = min(max(float(point @ end) / squared, 0.0), 1.0) if squared > 0 else 0.0
    return float(np.linalg.norm(point - along * end))


def _capsule(load: Payload, size: BodySize | None, flange_link: int) -> Capsule | None:
    if size is None:
        return payload_capsule(load, flange_link)
    length, radius = size
    return Capsule(flange_link, (0.0, 0.0, 0.0), (0.0, 0.0, length), radius)


def _environment(surroundings: Surroundings) -> Environment:
    return Environment(
        table_z=surroundings.table_z_m,
        walls=tuple(Plane(w.point_m, w.normal, w.name) for w in surroundings.walls),
        boxes=tuple(Box(b.centre_m, b.size_m, b.name) for b in surroundings.boxes),
    )
