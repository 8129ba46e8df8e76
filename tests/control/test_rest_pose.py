"""Rest poses: optimum against random search, clearance against coal, outcomes on pendulums."""

import numpy as np
import pytest

from hil.control.rest_pose import NEAREST, RestingArm, brakes_fail, described, least_loaded
from hil.core.errors import PlanError
from hil.dynamics import Box, CollisionModel, Environment, Plane, RobotModel
from hil.dynamics.sample_distances import SampleDistances

CEILING = Environment(table_z=0.0, walls=(Plane((0.0, 0.0, 0.6), (0.0, 0.0, -1.0), "ceiling"),))
UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])


def ur5(environment, gravity=(0.0, 0.0, -9.81), clearance_m=0.02, **other):
    robot = RobotModel.from_arm("ur5", gravity=gravity)
    return RestingArm(
        joint_names=robot.joint_names,
        gravity=robot.gravity,
        limit=robot.effort_max,
        low=robot.q_min,
        high=robot.q_max,
        around=CollisionModel(robot.arm, environment),
        clearance_m=clearance_m,
        **other,
    )


def pendulum(joints=1, low=-np.inf, high=np.inf, **other):
    """Joint 1 carries 10 N·m at the horizontal and hangs at 0; the others turn about a vertical."""

    def gravity(q):
        torque = np.zeros_like(q)
        torque[:, 0] = 10.0 * np.sin(q[:, 0])
        return torque

    names = tuple(f"joint{j + 1}" for j in range(joints))
    ends = np.full(joints, low), np.full(joints, high)
    return RestingArm(names, gravity, np.full(joints, 50.0), *ends, **other)


@pytest.fixture(scope="module")
def under_a_ceiling():
    arm = ur5(CEILING)
    return arm, least_loaded(arm, near=np.radians([30.0, -60.0, 100.0, 0.0, 0.0, 0.0]))


@pytest.mark.thorough
def test_no_random_pose_is_better(under_a_ceiling) -> None:
    arm, found = under_a_ceiling
    q = np.random.default_rng(12).uniform(-np.pi, np.pi, (60_000, 6))
    best = arm.effort(q[arm.is_clear(q)]).min()
    assert 0.0 < found[0].effort <= best
    assert found[0].effort > 0.25 * best


def test_every_pose_keeps_the_clearance(under_a_ceiling) -> None:
    arm, found = under_a_ceiling
    by_coal = SampleDistances(arm.around)
    assert all(by_coal.distances(pose.q[None]).min() >= 0.02 - 1e-6 for pose in found)
    assert min(pose.clearance for pose in found) < 0.021  # the ceiling is what holds it back


def test_the_pose_nearest_to_one_costs_hardly_more_than_the_least(under_a_ceiling) -> None:
    near = np.radians([30.0, -60.0, 100.0, 0.0, 0.0, 0.0])
    found = under_a_ceiling[1]
    nearest = next(pose for pose in found if pose.label == NEAREST)
    assert nearest.effort <= found[0].effort + 0.0101
    away = [np.linalg.norm(pose.q - near) for pose in found]
    assert np.linalg.norm(nearest.q - near) == min(away)


@pytest.mark.thorough
def test_an_upright_arm_loads_no_brake_and_tips_over() -> None:
    best = least_loaded(ur5(Environment(table_z=0.0)))[0]
    assert best.effort < 1e-4
    assert best.q == pytest.approx(UPRIGHT, abs=1e-3)
    assert best.fail.outcome == "tips"


@pytest.mark.thorough
def test_an_arm_that_hangs_from_the_ceiling_stays() -> None:
    best = least_loaded(ur5(Environment(table_z=0.0), gravity=(0.0, 0.0, 9.81)))[0]
    assert best.effort < 1e-4
    assert best.fail.outcome == "stays"
    assert best.fail.unstable == 0


@pytest.mark.thorough
def test_where_only_some_rest_poses_are_stable_one_of_them_is_shown() -> None:
    found = least_loaded(ur5(Environment(table_z=0.0), gravity=(9.81, 0.0, 0.0)))
    assert "stays" in {pose.fail.outcome for pose in found}


def test_the_same_arguments_give_the_same_poses() -> None:
    first, second = (least_loaded(pendulum(joints=3, low=0.1, high=6.0), seed=3) for _ in range(2))
    assert [pose.q.tolist() for pose in first] == [pose.q.tolist() for pose in second]


@pytest.mark.thorough
def test_a_box_in_the_way_is_kept_clear_of() -> None:
    box = Box((0.0, 0.0, 0.9), (0.4, 0.4, 0.3), "lamp")
    arm = ur5(Environment(table_z=0.0, boxes=(box,)), clearance_m=0.05)
    best = least_loaded(arm)[0]
    assert best.clearance >= 0.05 - 1e-6
    assert arm.is_clear(UPRIGHT[None])[0] == np.False_


@pytest.mark.parametrize(
    ("angle", "outcome", "stable", "unstable"),
    [(0.0, "stays", 1, 0), (np.pi, "tips", 0, 1), (np.pi / 2, "falls", 0, 0)],
    ids=["hanging", "upright", "level"],
)
def test_a_pendulum_without_friction(angle, outcome, stable, unstable) -> None:
    fail = brakes_fail(pendulum(), np.array([angle]))
    assert (fail.outcome, fail.stable, fail.unstable) == (outcome, stable, unstable)


def test_half_the_friction_above_the_torque_holds_a_pendulum_anywhere() -> None:
    q = np.array([np.pi / 2])
    assert brakes_fail(pendulum(friction=np.array([21.0])), q).outcome == "held"
    fail = brakes_fail(pendulum(friction=np.array([19.0])), q)
    assert fail.outcome == "falls"
    assert fail.spare == pytest.approx([-0.5])


def test_a_joint_about_a_vertical_axis_is_indifferent() -> None:
    fail = brakes_fail(pendulum(joints=3), np.array([0.0, 1.0, -2.0]))
    assert (fail.outcome, fail.stable, fail.indifferent) == ("stays", 1, 2)


def test_the_way_down_names_the_joint() -> None:
    fail = brakes_fail(pendulum(joints=3), np.array([np.pi, 0.0, 0.0]))
    assert fail.way_down == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_stiffness_is_the_derivative_of_gravity() -> None:
    arm = ur5(CEILING)
    q = np.array([0.3, -1.0, 0.8, -0.4, 0.7, 0.2])
    eps = 1e-6
    moved = [(arm.gravity((q + eps * e)[None]) - arm.gravity(q[None]))[0] / eps for e in np.eye(6)]
    assert arm.stiffness(q) == pytest.approx(np.array(moved).T, abs=1e-3)


def test_endless_joints_without_collision_bodies_find_the_bottom() -> None:
    best = least_loaded(pendulum(joints=2))[0]
    assert best.fail.outcome == "stays"
    assert np.cos(best.q[0]) == pytest.approx(1.0, abs=1e-6)
    assert best.clearance == np.inf


def test_limits_are_kept() -> None:
    best = least_loaded(pendulum(low=0.5, high=2.0))[0]
    assert best.q == pytest.approx([0.5])
    assert best.fail.outcome == "falls"


def test_free_joints_stay_where_they_are_wanted() -> None:
    found = least_loaded(pendulum(joints=2), near=np.array([0.1, 1.25]))
    assert all(pose.q[1] == pytest.approx(1.25) for pose in found)


def test_contradictory_limits_are_refused_by_name() -> None:
    with pytest.raises(PlanError, match="within the limits of joint1"):
        pendulum(low=1.0, high=-1.0)


def test_missing_torque_limits_are_refused_by_name() -> None:
    with pytest.raises(PlanError, match="no torque limits for j2"):
        RestingArm(("j1", "j2"), np.zeros_like, np.array([1.0, np.inf]), -np.ones(2), np.ones(2))


def test_no_clear_pose_is_an_error_that_says_how_far_off() -> None:
    shut_in = Box((0.0, 0.0, 0.5), (3.0, 3.0, 1.0), "cage")
    with pytest.raises(PlanError, match=r"clearance of 50 mm; the largest .* cage"):
        least_loaded(ur5(Environment(boxes=(shut_in,)), clearance_m=0.05))


def test_a_pose_that_is_not_clear_is_described_as_such() -> None:
    into_the_table = np.radians([0.0, 45.0, 0.0, 0.0, 0.0, 0.0])
    assert not described(ur5(CEILING), into_the_table, "given").clear
