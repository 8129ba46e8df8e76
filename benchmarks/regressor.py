"""Joint-torque regressors of 60,000 samples against plain per-sample loops over Pinocchio.

Two peers compute the same 60 columns: `vstack` gathers a matrix per sample in a list and stacks
them, `loop` writes them into one array made beforehand. A third, `reduced`, picks the columns of
the base parameters from what `loop` made, which is what a fit needs; ours does not compute the
others. Memory for the result is part of all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from hil.arms import load_arm
from hil.core.typing import FloatArray
from hil.dynamics import RobotModel, base_parameters
from hil.dynamics.build import model_from_arm
from hil.dynamics.regressor import COMPILED_FROM, compiles

ARM = "ur5"
SAMPLES = 60_000
REPEATS = 3
FEW = 1, 100
"""Samples at once in a control loop, and in an optimiser."""


def run(quick: bool = False) -> dict[str, Any]:
    """CPU seconds of ours and of the peers, and how many times less ours is."""
    samples = SAMPLES // 6 if quick else SAMPLES
    random = np.random.default_rng(0)
    motion = tuple(random.uniform(-3.0, 3.0, (3, samples, 6)))
    robot = RobotModel.from_arm(ARM)
    base = base_parameters(robot, rotor=False)
    robot.regressor(*(rows[:COMPILED_FROM] for rows in motion))  # compiled before the clock starts
    robot.inverse_dynamics(*(rows[:COMPILED_FROM] for rows in motion))
    times = {
        "regressor": _cpu_s(lambda: robot.regressor(*motion, rotor=False)),
        "base_regressor": _cpu_s(lambda: base.regressor(robot, *motion)),
        "inverse_dynamics": _cpu_s(lambda: robot.inverse_dynamics(*motion)),
        "pinocchio_vstack": _cpu_s(lambda: _stacked(motion)),
        "pinocchio_rnea": _cpu_s(lambda: _torques(motion)),
    }
    times["pinocchio_loop"] = _cpu_s(lambda: _filled(motion))
    times["pinocchio_reduced"] = _cpu_s(lambda: _filled(motion)[:, base.independent])
    _require_equal(robot, motion)
    return {
        "name": "regressor",
        "figures": {
            "samples": samples,
            "compiled": compiles(samples),
            **{f"{name}_cpu_s": seconds for name, seconds in times.items()},
            "us_per_sample": 1e6 * times["regressor"] / samples,
            **{f"{n}_samples_us": _few(robot, motion, n) for n in FEW},
        },
        "ratios": {
            "regressor_vs_pinocchio_vstack": times["pinocchio_vstack"] / times["regressor"],
            "regressor_vs_pinocchio_loop": times["pinocchio_loop"] / times["regressor"],
            "base_regressor_vs_pinocchio_reduced": times["pinocchio_reduced"]
            / times["base_regressor"],
            "inverse_dynamics_vs_pinocchio_loop": times["pinocchio_rnea"]
            / times["inverse_dynamics"],
        },
    }


def _stacked(motion: tuple[FloatArray, ...]) -> FloatArray:
    model = model_from_arm(load_arm(ARM))
    data = model.createData()
    q, qd, qdd = motion
    blocks = [
        np.array(pin.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k]))
        for k in range(len(q))
    ]
    return np.vstack(blocks)


def _filled(motion: tuple[FloatArray, ...]) -> FloatArray:
    model = model_from_arm(load_arm(ARM))
    data = model.createData()
    q, qd, qdd = motion
    out = np.empty((len(q), 6, 60))
    for k in range(len(q)):
        out[k] = pin.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k])
    return out.reshape(-1, 60)


def _torques(motion: tuple[FloatArray, ...]) -> FloatArray:
    model = model_from_arm(load_arm(ARM))
    data = model.createData()
    q, qd, qdd = motion
    out = np.empty(q.shape)
    for k in range(len(q)):
        out[k] = pin.rnea(model, data, q[k], qd[k], qdd[k])
    return out


def _require_equal(robot: RobotModel, motion: tuple[FloatArray, ...]) -> None:
    part = tuple(rows[:COMPILED_FROM] for rows in motion)
    ours, torque = robot.regressor(*part, rotor=False), robot.inverse_dynamics(*part)
    if not np.allclose(ours, _stacked(part), rtol=0, atol=1e-10):
        raise AssertionError("the two regressors differ")
    if not np.allclose(torque, _torques(part), rtol=0, atol=1e-10):
        raise AssertionError("the torques differ")


def _few(robot: RobotModel, motion: tuple[FloatArray, ...], samples: int) -> float:
    """Microseconds of CPU per call for a few samples."""
    part = tuple(rows[:samples] for rows in motion)
    calls = 500

    def call() -> None:
        for _ in range(calls):
            robot.regressor(*part, rotor=False)

    return 1e6 * _cpu_s(call) / calls


def _cpu_s(work: Callable[[], object]) -> float:
    """Least CPU time of a few repeats."""
    best = np.inf
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return float(best)


if __name__ == "__main__":
    print(run())
