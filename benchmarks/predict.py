"""One sample at a time: how long a controller waits for a model's effort.

A mock UR5's model with friction memory, the same with a residual network (three folds, every joint
kept), and a Lagrangian network of the default size: as the C program that `hil export` writes,
portable (-O2) and for this machine (-O3 -march=native); in Python, compiled or not; in onnxruntime
(also with its inputs and outputs bound to memory) and torch, as it is and compiled. Beside them
Pinocchio's rigid body alone, called directly and through hil. One thread each. Every call is timed
by itself; the clock's own time is in it. Maxima are the operating system's more than the program's.
Whoever is timed has to say what the model says.
"""

from __future__ import annotations

from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.prediction.agreement import off_by, require_agreement
from benchmarks.prediction.c_programs import FLAGS, build_of, timed_c
from benchmarks.prediction.clock import timed, told
from benchmarks.prediction.models import ARM, models
from benchmarks.prediction.pinocchio_alone import timed_pinocchio
from benchmarks.prediction.runtimes import timed_runtimes
from hil.control.predictor import Predictor
from hil.dynamics import load_model
from hil.estimators.base import RobotEstimator
from hil.export.c_compiler import compiler

CALLS, QUICK_CALLS = 100_000, 2_000
SLOW_SHARE = 20
"""What is no loop in C is called so many times less often."""

PEERS = ("compiled", "python", "onnxruntime", "onnxruntime_bound", "torch", "torch_compiled")


def run(quick: bool = False) -> dict[str, Any]:
    """Nanoseconds per call by contestant: p50, p99, max; ratios of medians to the portable C.

    `off_by`: largest difference from the model in Python, as a share of a joint's largest effort;
    `flags` says how each was built.

    Args:
        quick: Few calls of models fitted to little; nothing that takes long to compile.

    Raises:
        FitError: Somebody who is timed does not say what the model says.
    """
    if compiler() is None:
        absent = {"predict": "there is no C compiler"}
        return {"name": "predict", "figures": {}, "ratios": {}, "skipped": absent}
    calls = QUICK_CALLS if quick else CALLS
    figures: dict[str, float] = {}
    skipped: dict[str, str] = {}
    with threadpool_limits(1):
        contestants = models(quick)
        for name, model in contestants.items():
            figures |= timed_c(name, model, calls)
            figures |= _in_python(name, model, calls // SLOW_SHARE)
            if len(contestants) == 1:
                skipped = {"network": "torch is not installed"}
                continue
            times, left_out = timed_runtimes(name, model, calls // SLOW_SHARE, quick)
            figures |= times
            skipped |= left_out
        figures |= timed_pinocchio(load_model(ARM), calls // SLOW_SHARE)
    require_agreement(figures)
    return {
        "name": "predict",
        "figures": figures,
        "ratios": _ratios(figures, tuple(contestants)),
        "skipped": skipped,
        "flags": _flags(),
    }


def _ratios(figures: dict[str, float], names: tuple[str, ...]) -> dict[str, float]:
    def median(of: str) -> float:
        return figures[f"{of}_p50_ns"]

    found = {
        f"{name}_{peer}_over_c": median(f"{name}_{peer}") / median(f"{name}_portable")
        for name in names
        for peer in PEERS
        if f"{name}_{peer}_p50_ns" in figures
    }
    c = median("memory_portable")
    pinocchio = {
        "pinocchio_over_c": median("pinocchio_rnea") / c,
        "pinocchio_through_hil_over_c": median("pinocchio_through_hil") / c,
    }
    return found | pinocchio


def _flags() -> dict[str, str]:
    """How contestants are built, for people."""
    return {how: build_of(how) for how in FLAGS} | {
        "compiled": "the same C at -O3 -march=native, called through ctypes",
        "python": "the model's own stream",
        "onnxruntime": "CPU, one thread within and between operators, double precision",
        "onnxruntime_bound": "the same, inputs and outputs bound to memory of the runtime",
        "torch": "eager, inference mode, one thread, double precision",
        "torch_compiled": "torch.compile with its defaults, static shapes, one thread",
    }


def _in_python(name: str, model: RobotEstimator, calls: int) -> dict[str, float]:
    figures: dict[str, float] = {}
    for how, compiled in (("compiled", True), ("python", False)):
        step = Predictor(model, compiled=compiled).step
        figures |= told(f"{name}_{how}", timed(step, model.robot_, calls))
        figures[f"{name}_{how}_off_by"] = off_by(model, compiled=compiled)
    return figures


if __name__ == "__main__":
    print(run())
