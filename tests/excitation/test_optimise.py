"""Excitation that is optimised: the search, its roadmap, its plans, and what is kept of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from hil.arms import load_arm
from hil.core.errors import PlanError
from hil.core.typing import FloatArray
from hil.dynamics import CollisionModel, Environment, Plane, RobotModel, conditioning
from hil.dynamics.build import model_from_arm
from hil.excitation.cache import user_cache
from hil.excitation.motion import FourierSeries
from hil.excitation.optimiser import (
    Optimised,
    Progress,
    optimise,
    within_linear_limits,
)
from hil.excitation.problem import ExcitationProblem, LinearLimits, MotionLimits, ValueOf
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace, draw_poses, roomy_poses
from hil.planning.plan import Plan
from hil.planning.workspace import workspace_of
from hil.spec.experiment import ExperimentSpec
from tests.support.excitation_parts import Bench, Finder, bench, finder  # noqa: F401
from tests.support.plan_parts import JointSpace, plan_of, toy_workspace, ur5

# Optimised Fourier series: within all limits at all times, at rest at both ends, and better


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
    with pytest.raises(PlanError, match=r"shoulder_lift_joint needs [\d.]+ N·m, only 5 N·m are"):
        optimise(given, starts=1, seed=0, iterations=5)


@pytest.mark.thorough
def test_a_wall_nothing_can_keep_clear_of_is_a_plan_error_that_names_the_bodies() -> None:
    behind = Plane(point=(1.5, 0.0, 0.0), normal=(1.0, 0.0, 0.0))
    collision = CollisionModel(ROBOT.arm, Environment(walls=(behind,)))
    with pytest.raises(PlanError, match="and wall come within"):
        optimise(replace(problem(), collision=collision), starts=1, seed=0, iterations=5)


def test_a_callback_that_raises_stops_the_search() -> None:
    def stop(_: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimise(problem(), starts=1, progress=stop)


# Optimised trajectories of a spec for a real arm on a table: within all limits, complementary


ARM = load_arm("ur5")
ASKED = {"kind": "fourier", "trajectories": 2, "harmonics": 2, "fundamental_hz": 0.2}
LOAD_KG = 4.0
LOAD = {"mass_kg": LOAD_KG}
TORQUE = 0.4


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    asked = {"starts": 1, "torque_percent": 100 * TORQUE}
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("HIL_CACHE", str(tmp_path_factory.mktemp("cache")))
        return plan_of(excitation=ASKED | {"optimise": asked}, loads=[LOAD])


def series_of(plan: Plan) -> list[FourierSeries]:
    return [motion for motion in plan.motions if isinstance(motion, FourierSeries)]


@pytest.mark.thorough
def test_limits_and_clearance_hold_on_a_grid_ten_times_denser(plan: Plan) -> None:
    spec = ExperimentSpec.model_validate(
        {
            "hil": 1,
            "name": "x",
            "robot": "ur5",
            "excitation": ASKED,
            "loads": [{"mass_kg": LOAD_KG}],
        }
    )
    workspace = workspace_of(spec, ur5(), ARM, plan.rate_hz)
    for series in series_of(plan):
        dense = series.sample(10 * plan.rate_hz)
        assert np.abs(dense.qd).max() <= np.radians(100) + 1e-9
        assert np.abs(dense.qdd).max() <= np.radians(300) + 1e-9
        assert np.all((dense.q >= ARM.excite_min - 1e-9) & (dense.q <= ARM.excite_max + 1e-9))
        assert workspace.clearance(dense.q).min() >= workspace.clearance_m - 1e-5
        assert np.abs(dense.qd[-1]).max() < 1e-9
        assert np.abs(dense.qdd[-1]).max() < 1e-9


@pytest.mark.thorough
def test_torques_with_the_load_stay_below_their_share(plan: Plan) -> None:
    model = model_from_arm(ARM)
    frame = model.frames[model.getFrameId("flange")]
    body = pin.Inertia(LOAD_KG, np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    data = model.createData()
    for series in series_of(plan):
        samples = series.sample(plan.rate_hz)
        rows = zip(samples.q, samples.qd, samples.qdd, strict=True)
        largest = np.max([np.abs(pin.rnea(model, data, *row)) for row in rows], axis=0)
        assert np.all(largest <= TORQUE * ARM.effort_max * (1 + 1e-3))


@pytest.mark.thorough
def test_the_second_complements_the_first(plan: Plan) -> None:
    first, second = series_of(plan)
    assert condition(first, second) < 0.8 * min(condition(first), condition(second))


@pytest.mark.thorough
def test_a_plan_holds_its_trajectories_and_needs_no_cache(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIL_CACHE", "off")
    assert series_of(Plan.from_dict(plan.to_dict())) == series_of(plan)


@pytest.mark.thorough
def test_what_cannot_be_done_names_the_trajectory_and_what_is_in_the_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HIL_CACHE", "off")
    hopeless = {"starts": 1, "budget_s": 0.1, "torque_percent": 1}
    with pytest.raises(PlanError, match=r"trajectory 1: .* N·m, only 1.5 N·m are allowed") as error:
        plan_of(excitation=ASKED | {"optimise": hopeless})
    assert error.value.hint


def condition(*motions: FourierSeries) -> float:
    """Of the raw regressor with rotor inertias: largest over smallest singular value above zero."""
    model = model_from_arm(ARM)
    data, rows = model.createData(), []
    for motion in motions:
        samples = motion.sample(20.0)
        for q, qd, qdd in zip(samples.q, samples.qd, samples.qdd, strict=True):
            body = pin.computeJointTorqueRegressor(model, data, q, qd, qdd)
            rows.append(np.hstack([body, np.diag(qdd)]))
    W = np.vstack(rows)
    lengths = np.linalg.norm(W, axis=0)
    values = np.linalg.svd(W / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    return float(values[0] / values[values > 1e-9 * values[0]][-1])


# Ways between poses: straight when clear, else around, and never out of the connected part


def disc(q: FloatArray) -> FloatArray:
    """Forbidden: a disc of 0.6 rad around the origin."""
    return np.hypot(q[:, 0], q[:, 1]) - 0.6


def barrier(q: FloatArray) -> FloatArray:
    """Forbidden: a strip at 1 rad of the first joint, from limit to limit."""
    return np.abs(q[:, 0] - 1.0) - 0.1


def roadmap_in(workspace: Workspace) -> Roadmap:
    return Roadmap(workspace, roomy_poses(workspace, 32, seed=0))


def test_a_clear_straight_line_is_taken() -> None:
    roadmap = roadmap_in(toy_workspace(disc))
    start, goal = np.array([-1.0, 1.0]), np.array([1.0, 1.2])
    way = roadmap.way(start, goal)
    assert way is not None
    assert len(way) == 1
    np.testing.assert_array_equal(way[0].q_end, goal)


def test_a_blocked_line_is_led_around_with_every_sample_clear() -> None:
    roadmap = roadmap_in(toy_workspace(disc))
    start, goal = np.array([-1.0, 0.0]), np.array([1.0, 0.05])
    way = roadmap.way(start, goal)
    assert way is not None
    assert len(way) >= 2
    np.testing.assert_array_equal(way[0].q_start, start)
    np.testing.assert_array_equal(way[-1].q_end, goal)
    assert all(tuple(a.q_end) == tuple(b.q_start) for a, b in pairwise(way))
    for line in way:
        assert disc(line.sample(100.0).q).min() >= 0.02


def test_no_way_is_needed_to_where_one_is() -> None:
    roadmap = roadmap_in(toy_workspace(disc))
    here = np.array([1.0, 1.0])
    assert roadmap.way(here, here) == []


def test_a_pose_behind_a_barrier_has_no_way() -> None:
    roadmap = roadmap_in(toy_workspace(barrier))
    assert roadmap.way(np.array([0.0, 0.0]), np.array([1.4, 0.0])) is None


def test_the_roadmap_keeps_to_the_largest_connected_part() -> None:
    roadmap = roadmap_in(toy_workspace(barrier))
    assert np.all(roadmap.poses[:, 0] < 1.0)
    poses = np.array([[0.0, 0.0], [1.4, 0.0]])
    assert roadmap.seem_connected(poses).tolist() == [True, False]


def test_a_workspace_in_which_nothing_is_connected_is_refused() -> None:
    dust = toy_workspace(lambda q: np.where(np.abs(np.sin(40 * q)).min(axis=1) > 0.9, 0.1, -0.1))
    with pytest.raises(PlanError, match="no collision-free motion leads from one pose to another"):
        roadmap_in(dust)


def test_a_workspace_without_room_is_refused_with_the_clearance() -> None:
    with pytest.raises(PlanError, match=r"only 0 of 4096 .* keep 20 mm"):
        list(draw_poses(toy_workspace(lambda q: np.zeros(len(q))), seed=1))


def test_drawn_poses_fill_the_range_more_evenly_than_chance() -> None:
    poses = next(draw_poses(toy_workspace(), seed=3))[:200]
    share = (poses + 1.5) / 3.0
    assert np.all((share >= 0) & (share <= 1))
    counts, _, _ = np.histogram2d(*share.T, bins=5, range=[[0, 1], [0, 1]])
    # Chance gives a standard deviation of 2.8 around the mean of 8 a cell.
    assert np.std(counts) < 1.5


def test_drawn_poses_depend_on_the_seed_alone() -> None:
    first, again, other = (next(draw_poses(toy_workspace(), seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_asking_for_the_same_distances_again_costs_nothing() -> None:
    workspace = toy_workspace(disc)
    line = workspace.line(np.array([1.0, 1.0]), np.array([1.2, 1.0]))
    first = workspace.clearances([line, line])
    assert isinstance(workspace.collision, JointSpace)
    asked = workspace.collision.asked
    assert asked == len(line.sample(100.0))
    np.testing.assert_array_equal(workspace.clearances([line]), first[:1])
    assert workspace.collision.asked == asked


# Trajectories that took long are computed once, and nothing that is damaged is driven


def test_asking_again_computes_nothing(bench: Bench) -> None:  # noqa: F811
    before = bench.trajectories(2)
    assert bench.trajectories(2) == before
    assert bench.computed == 0


def test_asking_for_fewer_gives_the_first_ones(bench: Bench) -> None:  # noqa: F811
    before = bench.trajectories(3)
    assert bench.trajectories(1) == before[:1]
    assert len(bench.trajectories(3)) == 3
    assert bench.computed == 0


def test_asking_for_more_computes_only_the_new_ones(bench: Bench) -> None:  # noqa: F811
    before = bench.trajectories(2)
    assert bench.trajectories(3)[:2] == before
    assert bench.computed == 1


def test_a_later_trajectory_knows_of_those_from_the_cache(bench: Bench) -> None:  # noqa: F811
    bench.trajectories(2)
    bench.trajectories(3)
    (problem,) = bench.finder.problems
    assert problem.earlier is not None
    assert problem.earlier.shape[1] == problem.regressor(bench.trajectories(1)[0]).shape[1]


def test_what_was_found_before_an_interruption_is_not_lost(
    bench: Bench,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(problem: Any, **asked: Any) -> Any:
        if problem.earlier is not None:
            raise KeyboardInterrupt
        return bench.finder(problem, **asked)

    with monkeypatch.context() as patched:
        patched.setattr("hil.excitation.fourier.optimise", interrupted)
        with pytest.raises(KeyboardInterrupt):
            bench.trajectories(2)
    bench.trajectories(2)
    assert bench.computed == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"periods": 1', '"periods": 2'),
        lambda text: text.replace('"key": "', '"key": "0'),
        lambda text: "[]",
    ],
    ids=["torn", "changed", "of another question", "something else"],
)
def test_a_damaged_entry_is_told_and_computed_again(
    bench: Bench,  # noqa: F811
    damage: Callable[[str], str],
) -> None:
    before = bench.trajectories()
    bench.entry.write_text(damage(bench.entry.read_text()))
    assert bench.trajectories() == before
    assert bench.computed == 1
    assert "damaged" in bench.notes[0]
    assert json.loads(bench.entry.read_text())["trajectories"] == [before[0].to_dict()]


def test_fresh_computes_what_the_cache_has(bench: Bench) -> None:  # noqa: F811
    bench.trajectories()
    bench.trajectories(fresh=True)
    assert bench.computed == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 8}, {"objective": "condition"}, {"scaled": False}, {"clearance_mm": 25},
        {"torque_percent": 70}, {"friction": True}, {"rotor": False}, {"starts": 4},
        {"max_jerk_deg_s3": 900}, {"budget_s": 1},
    ],
    ids=lambda changes: next(iter(changes)),
)  # fmt: skip
def test_another_question_has_another_entry(bench: Bench, changes: dict[str, Any]) -> None:  # noqa: F811
    assert bench.key(**changes) != bench.key()


def test_how_many_are_asked_for_is_no_part_of_the_question(bench: Bench) -> None:  # noqa: F811
    assert bench.key(5) == bench.key(2)


def test_a_folder_that_cannot_be_written_to_is_told_and_no_obstacle(
    tmp_path: Path,
    finder: Finder,  # noqa: F811
) -> None:
    (tmp_path / "file").write_text("")
    bench = Bench(tmp_path / "file" / "cache", finder)  # noqa: F811
    assert len(bench.trajectories()) == 1
    assert "cannot create" in bench.notes[0]


def test_less_clearance_than_the_station_asks_for_is_refused(bench: Bench) -> None:  # noqa: F811
    with pytest.raises(PlanError, match=r"clearance_mm: 5 mm is less than the 20 mm"):
        bench.trajectories(clearance_mm=5)


def test_the_heaviest_load_is_what_torques_are_limited_for(bench: Bench) -> None:  # noqa: F811
    bench.trajectories(torque_percent=50)
    (problem,) = bench.finder.problems
    assert [load.mass for load in problem.robot.payloads] == [2.0]
    assert problem.limit("effort_max").tolist() == [75.0] * 6


def test_the_cache_is_where_the_environment_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIL_CACHE", str(tmp_path))
    assert user_cache().folder == tmp_path / "excitation"
    monkeypatch.setenv("HIL_CACHE", "off")
    assert user_cache().folder is None
    monkeypatch.delenv("HIL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setattr("sys.platform", "linux")
    assert user_cache().folder == tmp_path / "xdg" / "hil" / "excitation"
