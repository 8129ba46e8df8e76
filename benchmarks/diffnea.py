"""Links that can exist: damped Newton on compressed rows against L-BFGS, on the same loss.

A UR5 with Coulomb and viscous friction and noise is identified from the nominal arm, in
log-Cholesky coordinates. Ours compresses all rows to one triangle and takes Newton steps there;
`lbfgs` is SciPy's on the same triangle, `lbfgs_rows` the same on all rows, as training frameworks
go about it. All have exact gradients. What counts is the CPU time, compression included, until the
loss is within `EXCESS` of the least one found; who does not get there in `ITERATIONS` is charged
for all of them, so that his ratio is a lower bound, and `…_excess` says how far he got.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.optimize
from threadpoolctl import threadpool_limits

from hil.core.typing import FloatArray
from hil.dynamics import RobotModel, base_parameters
from hil.estimators.diffnea import Bodies, Problem, Unknowns, folding
from hil.estimators.diffnea_friction import FORMS, ArmMotion, sign_of, spread
from hil.estimators.least_squares import upper_triangle

SAMPLES, QUICK_SAMPLES = 12_000, 1_000
ITERATIONS, QUICK_ITERATIONS = 1_000, 100
EXCESS = 1e-3
NOISE_NM = np.array([2.0, 2.0, 1.0, 0.3, 0.3, 0.3])
ROTORS = np.array([0.75, 0.75, 0.62, 0.11, 0.11, 0.11])
FRICTION = np.array([[6, 8, 0.3], [7, 9, -0.2], [5, 6, 0.1], [1.5, 2, 0], [1.2, 1.5, 0], [1, 1, 0]])


@dataclass
class Course:
    """Cost by CPU time, of every evaluation."""

    cpu_s: list[float] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)

    def until(self, cost: float) -> float:
        """CPU seconds until that cost; until the end where it was not reached."""
        reached = (t for t, value in zip(self.cpu_s, self.cost, strict=True) if value <= cost)
        return next(reached, self.cpu_s[-1])


def run(quick: bool = False) -> dict[str, Any]:
    """CPU time until the same loss, and how low each got.

    Args:
        quick: Fewer samples and iterations.
    """
    most = QUICK_ITERATIONS if quick else ITERATIONS
    with threadpool_limits(1):
        sought, X, y = _observed(QUICK_SAMPLES if quick else SAMPLES)
        problem = Problem(sought, np.ones(6), 1.0)
        courses = {
            "newton": _newton(problem, X, y),
            "lbfgs": _lbfgs(problem, X, y, most, compressed=True),
            "lbfgs_rows": _lbfgs(problem, X, y, most, compressed=False),
        }
    least = min(min(course.cost) for course in courses.values())
    figures: dict[str, float] = {"rows": len(X), "unknowns": len(sought.start())}
    for name, course in courses.items():
        figures[f"{name}_cpu_s"] = course.until(least * (1.0 + EXCESS))
        figures[f"{name}_evaluations"] = len(course.cost)
        figures[f"{name}_excess"] = min(course.cost) / least - 1.0
    ours = figures["newton_cpu_s"]
    peers = ("lbfgs", "lbfgs_rows")
    ratios = {f"newton_vs_{peer}": figures[f"{peer}_cpu_s"] / ours for peer in peers}
    return {"name": "diffnea", "figures": figures, "ratios": ratios}


def _observed(samples: int) -> tuple[Unknowns, FloatArray, FloatArray]:
    """Return true coefficients, weighted rows X (M, p) and targets y (M,) of a UR5 motion."""
    nominal, plant = (RobotModel.from_arm("ur5", rotor_inertia=r) for r in (None, ROTORS))
    q, qd, qdd = _motion(samples)
    base, form = base_parameters(nominal, rotor=True), FORMS["coulomb-viscous"]
    motion = ArmMotion(qd, sign_of(qd, 0.01), np.zeros_like(qd), np.zeros_like(qd), given={})
    C, _ = form.evaluate(motion, np.zeros((6, 0)))
    noise = NOISE_NM * np.random.default_rng(1).normal(size=qd.shape)
    torque = plant.inverse_dynamics(q, qd, qdd) + np.einsum("Njk,jk->Nj", C, FRICTION) + noise
    weight = np.tile(1.0 / NOISE_NM, samples)
    X = np.hstack([base.regressor(nominal, q, qd, qdd), spread(C)]) * weight[:, None]
    scale = 0.1 * np.std(torque, axis=0)[:, None] / np.sqrt(np.mean(C**2, axis=0))
    sought = Unknowns(Bodies.nominal(nominal), folding(base), form, scale)
    return sought, X, torque.ravel() * weight


def _motion(samples: int) -> tuple[FloatArray, ...]:
    """Twelve fifth-order Fourier series of 10 s behind each other, each (N, 6)."""
    random = np.random.default_rng(0)
    t = np.arange(samples) / samples * 120.0
    w = 2 * np.pi * 0.1 * np.arange(1, 6)[:, None]
    wave = np.stack([np.sin(w * t), np.cos(w * t)]), np.stack([np.cos(w * t), -np.sin(w * t)])
    which = np.minimum(t // 10.0, 11).astype(int)
    a = random.uniform(-0.5, 0.5, (12, 2, 5, 6)) / np.arange(1, 6)[:, None]
    q = random.uniform(-1.5, 1.5, (12, 6))[which] + np.einsum("bkN,Nbkj->Nj", wave[0], a[which])
    qd = np.einsum("bkN,Nbkj->Nj", w * wave[1], a[which])
    return q, qd, -np.einsum("bkN,Nbkj->Nj", w**2 * wave[0], a[which])


def _newton(problem: Problem, X: FloatArray, y: FloatArray) -> Course:
    """Ours: compression and all steps, charged whatever the loss on the way."""
    begin = time.process_time()
    found = problem.frozen((X, y, np.zeros(len(y), dtype=np.int64)), problem.unknowns.start())
    return Course([time.process_time() - begin], [found.cost])


def _lbfgs(
    problem: Problem, X: FloatArray, y: FloatArray, iterations: int, *, compressed: bool
) -> Course:
    """SciPy's, on one triangle or on all rows."""
    course, begin = Course(), time.process_time()
    if compressed:
        R = upper_triangle(np.column_stack([X, y]))
        X, y = R[:, :-1], R[:, -1]

    def loss(u: FloatArray) -> tuple[float, FloatArray]:
        values, slope = problem.unknowns.at(u)
        away, r = problem.unknowns.divergence(u), X @ values - y
        cost = float(r @ r) + problem.prior * away.cost
        course.cpu_s.append(time.process_time() - begin)
        course.cost.append(cost)
        return cost, slope.T @ (2.0 * X.T @ r) + problem.prior * away.gradient

    options = {"maxiter": iterations, "maxfun": 2 * iterations, "ftol": 1e-12, "gtol": 1e-8}
    scipy.optimize.minimize(
        loss, problem.unknowns.start(), jac=True, method="L-BFGS-B", options=options
    )
    return course
