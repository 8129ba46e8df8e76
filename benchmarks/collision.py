"""Collision distances in numpy blocks against Pinocchio and coal, and the path search on top."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from hil.arms import ArmDescription, load_arm
from hil.core.typing import FloatArray, IntArray
from hil.dynamics import CollisionModel, Environment, smallest_along_paths
from hil.dynamics.build import model_from_arm

SAMPLES = 560_000
LEG_SAMPLES = 860
MARGIN_M = 0.02


def run(quick: bool = False) -> dict[str, Any]:
    """CPU time per sample and for a program of 650 legs that keep 2 cm clear."""
    samples = SAMPLES // 20 if quick else SAMPLES
    arm = load_arm("ur5")
    model = CollisionModel(arm, Environment(table_z=0.0))
    path = clear_program(model, arm, samples)
    every_s, distances = _cpu_s(lambda: model.clearance(path))
    search_s, least = _cpu_s(lambda: smallest_along_paths([path], model.distances, model.reach)[0])
    if abs(least[0] - distances.min()) > 1e-9:
        raise AssertionError("the path search missed the minimum")
    alone = CollisionModel(arm)
    some = path[:: max(1, samples // 20_000)]
    ours_s, ours = _cpu_s(lambda: alone.clearance(some))
    coal_s, theirs = _cpu_s(lambda: coal_clearance(arm, alone.pairs, some))
    if not np.allclose(ours, theirs, atol=1e-9):
        raise AssertionError("numpy and coal differ")
    return {
        "name": "collision",
        "figures": {
            "samples": len(path),
            "every_sample_cpu_s": every_s,
            "path_search_cpu_s": search_s,
            "numpy_us_per_sample": 1e6 * ours_s / len(some),
            "coal_us_per_sample": 1e6 * coal_s / len(some),
        },
        "ratios": {
            "path_search_vs_every_sample": every_s / search_s,
            "numpy_vs_coal": coal_s / ours_s,
        },
    }


def clear_program(model: CollisionModel, arm: ArmDescription, samples: int) -> FloatArray:
    """Legs from rest to rest between random poses, each of them clear."""
    random = np.random.default_rng(1)
    s = np.linspace(0.0, 1.0, LEG_SAMPLES)[:, None] ** 2
    s = s * (3 - 2 * s)
    at = np.radians([-90.0, -90, 90, -90, -90, 0])
    legs: list[FloatArray] = []
    while len(legs) * LEG_SAMPLES < samples:
        goal = random.uniform(arm.excite_min, arm.excite_max)
        leg = at + s * (goal - at)
        (least,) = model.clearances([leg])
        if least >= MARGIN_M:
            legs.append(leg)
            at = goal
    return np.concatenate(legs)


def coal_clearance(arm: ArmDescription, pairs: IntArray, q: FloatArray) -> FloatArray:
    """(N,) least distance by Pinocchio's `computeDistances`, sample by sample."""
    model, geometry = model_from_arm(arm), pin.GeometryModel()
    for i, capsule in enumerate(arm.capsules):
        a, b = np.array(capsule.a, dtype=np.float64), np.array(capsule.b, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        turn = Rotation.align_vectors([b - a], [[0, 0, 1]])[0] if length else Rotation.identity()
        at = _link_frame(arm, capsule.link) * pin.SE3(turn.as_matrix(), 0.5 * (a + b))
        shape = coal.Capsule(capsule.radius, length)
        geometry.addGeometryObject(pin.GeometryObject(str(i), capsule.link, at, shape))
    for i, j in pairs:
        geometry.addCollisionPair(pin.CollisionPair(int(i), int(j)))
    data, found = model.createData(), geometry.createData()
    out = np.empty(len(q))
    for k, sample in enumerate(q):
        nearest = pin.computeDistances(model, data, geometry, found, sample)
        out[k] = found.distanceResults[nearest].min_distance
    return out


def _link_frame(arm: ArmDescription, link: int) -> pin.SE3:
    """DH frame of a link in Pinocchio's joint frame."""
    if link == 0:
        return pin.SE3.Identity()
    a, alpha, d, _ = arm.dh[link - 1]
    return pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))


def _cpu_s(work: Callable[[], FloatArray]) -> tuple[float, FloatArray]:
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


if __name__ == "__main__":
    print(run())
