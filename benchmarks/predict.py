"""One sample at a time: how long a controller waits for a model's effort.

A mock UR5's model with friction memory, and the same with a residual network (three folds, every
joint kept), as the C program that `hil export` writes, portable (-O2) and for this machine
(-O3 -march=native); beside it the same model in Python, compiled or not, and Pinocchio's rigid body
alone. Every call is timed by itself; the clock's own time is in it. Maxima are the operating
system's more than the program's.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.identification.mock_gap import observed
from hil.deploy.export.c_build import built, compiler
from hil.deploy.export.c_export import export_c
from hil.deploy.export.golden import motion
from hil.deploy.predictor import Predictor
from hil.dynamics import RobotModel, load_model
from hil.identify import estimator
from hil.identify.base import RobotEstimator
from hil.typing import FloatArray

ARM, SEED = "ur5", 1
TRAJECTORIES, QUICK_TRAJECTORIES = 8, 3
CALLS, QUICK_CALLS = 100_000, 2_000
SLOW_SHARE = 20
"""Python is called so many times less often."""

FLAGS = {"portable": ("-O2",), "native": ("-O3", "-march=native")}
RATE_HZ = 1000.0
LOUDER = 1e3

HARNESS = r"""#define _POSIX_C_SOURCE 199309L
#include "hil.h"
#include <math.h>
#include <stdio.h>
#include <time.h>
int main(void)
{
    static hil_state s;
    double q[HIL_N], qd[HIL_N], qdd[HIL_N], effort[HIL_N], sum = 0.0;
    long k;
    int j;
    hil_reset(&s);
    for (k = 0; k < @CALLS@; k++) {
        struct timespec a, b;
        for (j = 0; j < HIL_N; j++) {
            const double w = 2.0 + 0.3 * j, t = (double)k * 1e-3;
            q[j] = 0.8 * sin(w * t + j); qd[j] = 0.8 * w * cos(w * t + j); qdd[j] = -w * w * q[j];
        }
        clock_gettime(CLOCK_MONOTONIC, &a);
        hil_step(&s, q, qd, qdd, effort, NULL);
        clock_gettime(CLOCK_MONOTONIC, &b);
        sum += effort[0];
        printf("%ld\n", (long)(b.tv_sec - a.tv_sec) * 1000000000L + (b.tv_nsec - a.tv_nsec));
    }
    return sum != sum;
}
"""


def run(quick: bool = False) -> dict[str, Any]:
    """Nanoseconds per call by contestant: p50, p99, max; ratios of medians to the portable C.

    Args:
        quick: Few calls of a model fitted to little.
    """
    if compiler() is None:
        absent = {"predict": "there is no C compiler"}
        return {"name": "predict", "figures": {}, "ratios": {}, "skipped": absent}
    calls = QUICK_CALLS if quick else CALLS
    figures: dict[str, float] = {}
    with threadpool_limits(1):
        models = _models(quick)
        for name, model in models.items():
            figures |= _of_c(name, model, calls)
            for how, predictor in _in_python(model).items():
                figures |= _told(f"{name}_{how}", _timed(predictor.step, model.robot_, calls))
        robot = load_model(ARM)
        figures |= _told("pinocchio_rnea", _timed(_rnea(robot), robot, calls))
    ratios = {
        f"{slow}_over_c": figures[f"{slow}_p50_ns"] / figures[f"{c}_portable_p50_ns"]
        for c in models
        for slow in (f"{c}_compiled", f"{c}_python")
    }
    ratios["pinocchio_over_c"] = (
        figures["pinocchio_rnea_p50_ns"] / figures["memory_portable_p50_ns"]
    )
    skipped = {} if "network" in models else {"network": "torch is not installed"}
    return {"name": "predict", "figures": figures, "ratios": ratios, "skipped": skipped}


def _models(quick: bool) -> dict[str, RobotEstimator]:
    robot = load_model(ARM)
    data = observed(SEED, ARM, QUICK_TRAJECTORIES if quick else TRAJECTORIES).data
    kept = {k: v for k, v in data.columns.items() if k in ("t", "q", "qd", "effort")}
    data = replace(data, columns=kept)
    chosen: dict[str, Any] = {"friction": ["core"], "fit_shapes": False} if quick else {}
    memory = estimator("rigid-hysteresis", consistent=False, **chosen).fit(data, robot)
    found: dict[str, RobotEstimator] = {"memory": memory}
    if find_spec("torch") is not None:
        # How long a network takes does not depend on how well it was trained.
        base = {"estimator": memory.estimator, "consistent": False, **chosen}
        once = {"epochs": 1, "device": "cpu"}
        network: Any = estimator("residual", base=base, training=once)
        network = network.fit_on(memory, data, robot)
        # Hardly trained, it hardly says anything: made louder, its agreement means something.
        loud = tuple(replace(one, scale=LOUDER * one.scale) for one in network.correction_.networks)
        every = np.ones(robot.n, dtype=bool)
        network.correction_ = replace(network.correction_, kept=every, networks=loud)
        found["network"] = network
    return found


def _of_c(name: str, model: RobotEstimator, calls: int) -> dict[str, float]:
    figures = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "c"
        told = export_c(model, folder)
        figures[f"{name}_off_by"] = float(told.checked.split()[3])
        (folder / "harness.c").write_text(HARNESS.replace("@CALLS@", f"{calls}L"), "utf-8")
        for how, flags in FLAGS.items():
            program = built(folder, ("harness.c", "hil.c"), f"bench_{how}", flags)
            figures |= _told(f"{name}_{how}", _printed(program))
        shutil.rmtree(folder)
    return figures


def _printed(program: Path) -> FloatArray:
    import subprocess

    said = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    return np.array(said.split(), dtype=np.float64)


def _in_python(model: RobotEstimator) -> dict[str, Predictor]:
    return {
        "compiled": Predictor(model, compiled=True),
        "python": Predictor(model, compiled=False),
    }


def _rnea(robot: RobotModel) -> Callable[..., FloatArray]:
    def step(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        return robot.inverse_dynamics(q[None], qd[None], qdd[None])

    return step


def _timed(step: Callable[..., FloatArray], robot: RobotModel, calls: int) -> FloatArray:
    """Nanoseconds of every call."""
    count = max(200, calls // SLOW_SHARE)
    samples = list(zip(*motion(robot, count, RATE_HZ), strict=True))
    found = np.empty(count)
    for k, sample in enumerate(samples):
        begin = time.perf_counter_ns()
        step(*sample)
        found[k] = time.perf_counter_ns() - begin
    return found


def _told(name: str, ns: FloatArray) -> dict[str, float]:
    p50, p99 = np.percentile(ns, [50, 99])
    return {
        f"{name}_p50_ns": float(p50),
        f"{name}_p99_ns": float(p99),
        f"{name}_max_ns": float(np.max(ns)),
    }


if __name__ == "__main__":
    print(run())
