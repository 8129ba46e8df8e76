"""Optimised Fourier series: within all limits at all times, at rest at both ends, and better."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.core.errors import PlanError
from hil.core.typing import FloatArray
from hil.dynamics import CollisionModel, Environment, Plane, RobotModel, conditioning
from hil.excitation.motion import FourierSeries
from hil.excitation.optimiser import (
    Optimised,
    Progress,
    optimise,
    within_linear_limits,
)
from hil.excitation.problem import ExcitationProblem, LinearLimits, MotionLimits, ValueOf

ROBOT = RobotModel.from_arm("ur5")
SPEED, ACCELERATION = 2.0, 6.0
RATE_HZ = 500.0
"""Of the dense check: 5000 samples where the limits are kept on 200 points."""


def problem(**changes: Any) -> ExcitationProblem:
    limits = {"q_min": -np.pi, "q_max": np.pi, "qd_max": SPEED, "qdd_max": ACCELERATION}
    return ExcitationProblem(ROBOT, **(limits | {"scaled": False} | changes))


@pytest.fixture(scope="module")
def found() -> Optimised:
    return optimise(problem(), starts=1, seed=3, iterations=40)


def jerk(series: FourierSeries) -> FloatArray:
    qdd = series.sample(RATE_HZ).qdd
    return np.asarray(np.diff(qdd, axis=0) * RATE_HZ)


@pytest.mark.thorough
def test_all_limits_are_kept_between_the_points_of_the_grid(found: Optimised) -> None:
    dense = found.series.sample(RATE_HZ)
    assert np.abs(dense.q).max() <= np.pi
    assert np.abs(dense.qd).max() <= SPEED
    assert np.abs(dense.qdd).max() <= ACCELERATION
    assert np.abs(dense.qd).max() > 0.98 * SPEED, "limits that are not used excite less"


def test_the_motion_rests_at_both_ends(found: Optimised) -> None:
    last = found.series.sample(RATE_HZ)
    assert np.abs(last.qd[-1]).max() < 1e-9
    assert np.abs(last.qdd[-1]).max() < 1e-9
    np.testing.assert_allclose(last.q[-1], found.series.q_start, atol=1e-9)


def test_the_condition_is_that_of_pinocchios_base_regressor_on_many_samples(
    found: Optimised,
) -> None:
    many = found.series.sample(100.0)
    W = ROBOT.regressor(many.q, many.qd, many.qdd, rotor=False)
    base = problem().columns
    kept = [ROBOT.parameter_names(rotor=False).index(name.split()[0]) for name in base.names]
    assert np.linalg.cond(W[:, kept]) == pytest.approx(found.condition_raw, rel=0.02)
    assert found.objective == found.condition_raw


@pytest.mark.thorough
def test_it_is_far_better_than_the_best_of_many_random_motions(found: Optimised) -> None:
    limits, value_of = LinearLimits(problem()), ValueOf(problem())
    rng = np.random.default_rng(0)
    drawn = [value_of(within_linear_limits(limits, rng), 64.0).exact for _ in range(100)]
    assert found.condition_raw < 0.5 * min(drawn)


def test_the_gradient_by_the_coefficients_is_that_of_finite_differences() -> None:
    given = problem(friction=True, sign_width=0.3, scaled=True, earlier=np.eye(54))
    value_of = ValueOf(given)
    free = within_linear_limits(LinearLimits(given), np.random.default_rng(1))
    gradient = value_of(free, 8.0).gradient.reshape(free.shape)
    for place in [(0, 0), (1, 3), (2, 7), (4, 1), (5, 8)]:
        there, back = free.copy(), free.copy()
        there[place] += 1e-5
        back[place] -= 1e-5
        slope = (value_of(there, 8.0).value - value_of(back, 8.0).value) / 2e-5
        assert gradient[place] == pytest.approx(slope, rel=1e-5, abs=1e-7)


def test_the_same_seed_finds_the_same_series() -> None:
    short = [optimise(problem(), starts=1, seed=5, iterations=6).series for _ in range(2)]
    assert short[0] == short[1]


def test_several_starts_keep_the_best_and_tell_of_all(found: Optimised) -> None:
    told: list[Progress] = []
    begun = time.monotonic()
    several = optimise(problem(), starts=2, seed=3, iterations=8, progress=told.append)
    elapsed_s = time.monotonic() - begun
    assert [start.seed for start in several.starts] == [(3, 0), (3, 1)]
    assert several.objective == pytest.approx(min(start.value for start in several.starts))
    assert {one.start for one in told} == {0, 1}
    assert told[-1].best <= told[0].best
    remaining = [one.eta_s for one in told]
    assert remaining[-1] is not None
    assert remaining[0] is not None
    assert remaining[-1] < remaining[0] + elapsed_s


@pytest.mark.thorough
def test_jerk_and_nominal_torque_are_kept() -> None:
    given = problem(jerk_max=20.0, effort_max=[60.0, 60.0, 30.0, 6.0, 6.0, 3.0])
    limited = optimise(given, starts=1, seed=1, iterations=12)
    dense = limited.series.sample(RATE_HZ)
    effort = np.abs(ROBOT.inverse_dynamics(dense.q, dense.qd, dense.qdd)).max(axis=0)
    assert np.all(effort <= given.limit("effort_max"))
    assert np.abs(jerk(limited.series)).max() <= 20.0
    assert limited.margins.feasible
    assert limited.margins.effort == pytest.approx(1 - effort / given.limit("effort_max"), abs=1e-3)


@pytest.mark.thorough
def test_distance_to_table_and_self_is_kept() -> None:
    collision = CollisionModel(ROBOT.arm, Environment(table_z=0.0))
    given = problem(collision=collision, clearance_m=0.03)
    clear = optimise(given, starts=1, seed=1, iterations=12)
    least = collision.clearance(clear.series.sample(RATE_HZ).q).min()
    assert least >= 0.03 - 1e-6
    assert clear.margins.clearance_m == pytest.approx(least - 0.03, abs=2e-3)
    assert clear.condition_raw < 60


def test_gradients_of_distances_and_torques_are_those_of_finite_differences() -> None:
    collision = CollisionModel(ROBOT.arm)
    given = problem(collision=collision, clearance_m=0.03, effort_max=50.0)
    limits = MotionLimits(given)
    free = within_linear_limits(LinearLimits(given), np.random.default_rng(2))
    excess = limits.excess(free)
    numbers = np.argsort(-excess.ravel())[[0, 30, 100]]
    rows = limits.rows(free, numbers).reshape(-1, *free.shape)
    for place in [(1, 0), (2, 4)]:
        step = np.zeros(free.shape)
        step[place] = 1e-6
        slope = (limits.excess(free + step) - limits.excess(free - step)).ravel()[numbers] / 2e-6
        np.testing.assert_allclose(rows[:, *place], slope, rtol=1e-4, atol=1e-4)


@pytest.mark.thorough
def test_a_second_trajectory_made_to_complement_betters_both_more_than_one_made_alone(
    found: Optimised,
) -> None:
    joint = optimise(problem().after(found.series), starts=1, seed=8, iterations=25)
    alone = optimise(problem(), starts=1, seed=8, iterations=25)
    beside = conditioning(problem().information(found.series, alone.series)).raw
    assert joint.condition_raw < found.condition_raw
    assert joint.condition_raw < beside
    both = np.concatenate([problem().regressor(s) for s in (found.series, joint.series)])
    assert joint.condition_raw == pytest.approx(np.linalg.cond(both), rel=1e-6)


@pytest.mark.thorough
def test_a_large_determinant_can_be_asked_for_instead() -> None:
    given = problem(objective="log_det")
    best = optimise(given, starts=1, seed=0, iterations=25)
    sign, log_det = np.linalg.slogdet(best.information.T @ best.information)
    assert sign > 0
    assert best.objective == pytest.approx(log_det)
    assert best.objective > -best.starts[0].drawn + 20


def test_limits_that_exclude_each_other_are_refused_by_name() -> None:
    with pytest.raises(PlanError, match=r"range of elbow_joint is empty.*qdd_max of shoulder_pan"):
        problem(
            q_min=[-1.0, -1.0, 1.0, -1.0, -1.0, -1.0],
            q_max=1.0,
            qdd_max=[0.0, 1.0, 1.0, 1.0, 1.0, 1.0],
        )


@pytest.mark.thorough
def test_a_torque_that_cannot_hold_the_arm_is_a_plan_error_that_names_the_joint() -> None:
    upright = {"q_min": [-3, -0.3, -0.3, -3, -3, -3], "q_max": [3, 0.3, 0.3, 3, 3, 3]}
    given = problem(**upright, effort_max=[100.0, 5.0, 100.0, 28.0, 28.0, 28.0])
    with pytest.raises(PlanError, match=r"shoulder_lift_joint needs [\d.]+ N·m where 5 are"):
        optimise(given, starts=1, seed=0, iterations=5)


@pytest.mark.thorough
def test_a_wall_nothing_can_keep_clear_of_is_a_plan_error_that_names_the_bodies() -> None:
    behind = Plane(point=(1.5, 0.0, 0.0), normal=(1.0, 0.0, 0.0))
    collision = CollisionModel(ROBOT.arm, Environment(walls=(behind,)))
    with pytest.raises(PlanError, match="and wall come as near as"):
        optimise(replace(problem(), collision=collision), starts=1, seed=0, iterations=5)


def test_a_callback_that_raises_stops_the_search() -> None:
    def stop(_: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimise(problem(), starts=1, progress=stop)
