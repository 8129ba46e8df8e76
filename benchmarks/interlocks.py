"""The default interlocks over a dwell program, against a loop that computes every sample."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import load_arm
from hil.core.typing import StructArray
from hil.dynamics import CollisionModel
from hil.dynamics.sample_distances import SampleDistances
from hil.engine.interlocks import InterlockContext, Interlocks, interlocks_from_spec
from hil.planning.build import build_plan
from hil.planning.plan import Plan
from hil.planning.workspace import collision_model
from hil.robot import Status, state_dtype
from hil.spec import ExperimentSpec, StationRobot

POSES, QUICK_POSES = 24, 4
PEER_ROWS, QUICK_PEER_ROWS = 4000, 500
BLOCKS = (1, 16, 64)
REPEATS = 3
ENCODER_NOISE_RAD = 2e-5


def run(quick: bool = False) -> dict[str, Any]:
    """CPU time per sample of the whole default set, in blocks of several lengths.

    Args:
        quick: Fewer poses.
    """
    spec = _spec(QUICK_POSES if quick else POSES)
    robot = StationRobot(driver="mock", model="ur5")
    plan = build_plan(spec, robot)
    bodies = collision_model(load_arm("ur5"), robot.surroundings, [])
    rows = rows_of(plan)
    figures: dict[str, float] = {"samples": len(rows)}
    for length in BLOCKS:
        seconds, share = _judge_all(spec, bodies, rows, length)
        figures[f"us_per_sample_in_blocks_of_{length}"] = 1e6 * seconds / len(rows)
        figures["computed_percent"] = 100 * share
    some = rows[: QUICK_PEER_ROWS if quick else PEER_ROWS]
    peer_s = _cpu_s(lambda: every_sample(bodies, some), 1)
    figures["us_per_sample_every_sample"] = 1e6 * peer_s / len(some)
    figures |= _one_sample(bodies, some)
    peer = figures["us_per_sample_every_sample"]
    ratios = {f"blocks_of_{n}": peer / figures[f"us_per_sample_in_blocks_of_{n}"] for n in BLOCKS}
    ratios |= {
        f"blocks_of_{n}_vs_coal": figures["coal_us"] / figures[f"us_per_sample_in_blocks_of_{n}"]
        for n in BLOCKS
    }
    ratios["coal_vs_numpy_one_sample"] = figures["numpy_us"] / figures["coal_us"]
    return {"name": "interlocks", "figures": figures, "ratios": ratios}


def rows_of(plan: Plan) -> StructArray:
    """State rows of an arm that follows its plan exactly, but for encoder noise."""
    q = np.concatenate([motion.sample(plan.rate_hz).q for motion in plan.motions])
    rows = np.zeros(len(q), state_dtype(q.shape[1]))
    rows["device_time"] = np.arange(len(q)) / plan.rate_hz
    rows["q_target"] = q
    rows["q"] = q + np.random.default_rng(0).normal(0.0, ENCODER_NOISE_RAD, q.shape)
    rows["temperature"], rows["status"] = 30.0, Status.MOVING
    return rows


def every_sample(bodies: CollisionModel, rows: StructArray) -> None:
    """Check every quantity of every sample and compute all distances: the peer."""
    arm = bodies.arm
    most = 0.95 * arm.effort_max / arm.drive_gains
    for row in rows:
        far = np.abs(row["q"] - row["q_target"]).max() > 0.05
        hot = row["temperature"].max() > 75.0
        strained = (np.abs(row["effort"]) > most).any()
        if far or hot or strained or bodies.clearance(row["q"][None])[0] < 0.01:
            raise AssertionError("the program trips")


def _spec(poses: int) -> ExperimentSpec:
    return ExperimentSpec.model_validate(
        {
            "hil": 1,
            "name": "bench",
            "robot": "ur5",
            "excitation": {"kind": "dwell", "waypoints": poses},
            "warm_up": {"duration_s": 0},
        }
    )


def _interlocks(spec: ExperimentSpec, bodies: CollisionModel) -> Interlocks:
    arm = bodies.arm
    context = InterlockContext(
        joint_names=arm.joint_names,
        drive_gains=tuple(arm.drive_gains.tolist()),
        effort_max=tuple(arm.effort_max.tolist()),
        clearance=SampleDistances(bodies),
        clearance_m=0.02,
        behind_s=lambda: 0.0,
        folder=Path,
    )
    return interlocks_from_spec(spec.interlocks, context)


def _judge_all(
    spec: ExperimentSpec, bodies: CollisionModel, rows: StructArray, length: int
) -> tuple[float, float]:
    """CPU seconds for all rows, and the share of them whose distances were computed."""
    blocks = [rows[begin : begin + length] for begin in range(0, len(rows), length)]
    interlocks = _interlocks(spec, bodies)

    def judge() -> None:
        for block in blocks:
            for interlock in interlocks:
                if interlock.check(block) is not None:
                    raise AssertionError("the program trips")

    seconds = _cpu_s(judge, REPEATS)
    computed = sum(getattr(interlock, "computed", 0) for interlock in interlocks)
    interlocks.close()
    return seconds, computed / REPEATS / len(rows)


def _one_sample(bodies: CollisionModel, rows: StructArray) -> dict[str, float]:
    alone, some = SampleDistances(bodies), [row[None] for row in rows["q"][::10]]
    for q in some:
        if not np.allclose(alone.distances(q), bodies.distances(q), atol=1e-5):
            raise AssertionError("numpy and coal differ")
    coal_s = _cpu_s(lambda: [alone.distances(q) for q in some], REPEATS)
    numpy_s = _cpu_s(lambda: [bodies.distances(q) for q in some], REPEATS)
    return {"coal_us": 1e6 * coal_s / len(some), "numpy_us": 1e6 * numpy_s / len(some)}


def _cpu_s(work: Callable[[], object], repeats: int) -> float:
    """Least CPU time of some repeats [s]."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds)


if __name__ == "__main__":
    print(run())
