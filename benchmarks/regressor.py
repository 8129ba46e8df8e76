"""Joint-torque regressors of 60,000 samples against a plain per-sample loop over Pinocchio."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from hil.dynamics import RobotModel
from hil.dynamics.build import model_from_arm
from hil.typing import FloatArray

ARM = "ur5"
SAMPLES = 60_000
REPEATS = 3


def run(quick: bool = False) -> dict[str, Any]:
    """CPU seconds for the regressor, the torques and base reduction, and the peer's regressor."""
    samples = SAMPLES // 10 if quick else SAMPLES
    random = np.random.default_rng(0)
    q, qd, qdd = random.uniform(-3.0, 3.0, (3, samples, 6))
    model = RobotModel.from_arm(ARM)
    ours, W = _cpu_s(lambda: model.regressor(q, qd, qdd, rotor=False))
    theirs, peer = _cpu_s(lambda: _stacked(q, qd, qdd))
    torques, _ = _cpu_s(lambda: model.inverse_dynamics(q, qd, qdd))
    if not np.allclose(W, peer, atol=1e-9):
        raise AssertionError("the two regressors differ")
    return {
        "name": "regressor",
        "figures": {
            "samples": samples,
            "regressor_cpu_s": ours,
            "pinocchio_vstack_cpu_s": theirs,
            "inverse_dynamics_cpu_s": torques,
            "us_per_sample": 1e6 * ours / samples,
        },
        "ratios": {"regressor_vs_pinocchio_vstack": theirs / ours},
    }


def _stacked(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
    from hil.arms import load_arm

    model = model_from_arm(load_arm(ARM))
    data = model.createData()
    blocks = [
        np.array(pin.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k]))
        for k in range(len(q))
    ]
    return np.vstack(blocks)


def _cpu_s(work: Callable[[], FloatArray]) -> tuple[float, FloatArray]:
    """Least CPU time of a few repeats and the last result."""
    best = np.inf
    for _ in range(REPEATS):
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return float(best), result


if __name__ == "__main__":
    print(run())
