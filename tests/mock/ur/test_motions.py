"""Motions of the mock UR controller: what they promise, for whatever is commanded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.arms import load_arm
from hil_mock_robot.ur.kinematics import pose_of, pose_trans, tool_velocity
from hil_mock_robot.ur.motion import (
    Leg,
    MovePath,
    ServoJ,
    SpeedJ,
    SpeedL,
    StopJoints,
    StopL,
)
from hil_mock_robot.ur.motion_limits import (
    JOINT_LIMITS,
    SINGULARITY,
    SUDDEN_CHANGE,
    MotionImpossible,
)
from tests.support.ur_machine import movej, movej_to_pose, movel

ARM = load_arm("ur5")
TCP = np.array([0.02, -0.01, 0.1, 0.1, 0.2, -0.3])
START = np.radians([10.0, -80.0, -100.0, -80.0, 95.0, 20.0])
CB3, E_SERIES = 1 / 125, 1 / 500
LONGEST_S = 120.0
ROUNDING = 1 + 1e-6

RATES = st.sampled_from([CB3, CB3, E_SERIES])
GOALS = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)
SPEEDS, ACCELERATIONS = st.floats(0.5, 3.0), st.floats(0.5, 15.0)
SLIDERS = st.lists(
    st.tuples(st.integers(1, 60), st.sampled_from([0.0, 0.05, 0.3, 0.7, 1.0])), max_size=6
)
STEPS = st.tuples(
    *[st.floats(-0.12, 0.12)] * 3, *[st.floats(-0.4, 0.4)] * 3
).map(np.array)  # fmt: skip


def standing(q, qd=None):
    return np.array([q, np.zeros(6) if qd is None else qd, np.zeros(6)])


def slid(changes):
    """A speed slider: each setting for so many ticks, then all open."""
    for ticks, setting in changes:
        yield from [setting] * ticks
    while True:
        yield 1.0


def play(motion, start=START, tick=CB3, sliders=(), qd=None, limit_s=LONGEST_S):
    """All set-points (N, 3, 6), the first of them where it began, until the motion is over."""
    now, path, slider = standing(start, qd), [standing(start, qd)], slid(sliders)
    while (now := motion.advance(now, next(slider))) is not None:
        path.append(now)
        assert len(path) * tick < limit_s, "it does not end"
    return np.array(path)


def until_impossible(motion):
    """Set-points until a motion gives up, and why it does."""
    path = [standing(START)]
    for _ in range(3000):
        try:
            path.append(motion.advance(path[-1], 1.0))
        except MotionImpossible as error:
            return np.array(path), error
    pytest.fail("it goes on and on")


def steps_of(path, tick):
    """Speeds and accelerations by differences of positions and of speeds."""
    return np.diff(path[:, 0], axis=0) / tick, np.diff(path[:, 1], axis=0) / tick


def tool_of(path):
    """Poses and twists of the tool along a path."""
    poses = np.array([pose_of(ARM, q, TCP) for q, _, _ in path])
    return poses, np.array([tool_velocity(ARM, q, qd, TCP) for q, qd, _ in path])


def at_rest(setpoint):
    return not setpoint[1:].any()


def moved(pose, step):
    """A pose a step away: (3,) metres in the base frame, (3,) a turn in the tool's."""
    turn = (Rotation.from_rotvec(pose[3:]) * Rotation.from_rotvec(step[3:])).as_rotvec()
    return np.concatenate((pose[:3] + step[:3], turn))


def turn_between(a, b):
    return (Rotation.from_rotvec(a[3:]).inv() * Rotation.from_rotvec(b[3:])).magnitude()


class TestMoveJ:
    @given(goal=GOALS, v=SPEEDS, a=ACCELERATIONS, tick=RATES, sliders=SLIDERS)
    @settings(max_examples=25, deadline=None)
    def test_it_keeps_speed_and_acceleration_and_ends_at_rest_just_where_it_should(
        self, goal, v, a, tick, sliders
    ):
        path = play(movej(goal, v, a, tick), tick=tick, sliders=sliders)
        speeds, accelerations = steps_of(path, tick)
        assert np.abs(path[:, 1]).max() <= v * ROUNDING
        assert np.abs(path[:, 2]).max() <= a * ROUNDING
        assert np.abs(speeds).max() <= v * ROUNDING
        assert np.abs(accelerations).max() <= a * ROUNDING
        assert path[-1, 0] == pytest.approx(goal, abs=1e-12)
        assert at_rest(path[-1])

    @pytest.mark.thorough
    @given(goal=GOALS, sliders=SLIDERS)
    @settings(max_examples=20, deadline=None)
    def test_all_joints_are_as_far_on_their_ways_at_any_moment(self, goal, sliders):
        path = play(movej(goal, 1.0, 2.0, CB3), sliders=sliders)
        way = goal - START
        leader = np.abs(way).argmax()
        share = (path[:, 0, leader] - START[leader]) / way[leader]
        assert path[:, 0] == pytest.approx(START + share[:, None] * way, abs=1e-12)
        assert (np.diff(share) >= -1e-12).all()

    @pytest.mark.parametrize(("way", "v", "a"), [(1.5, 1.05, 1.4), (0.2, 1.05, 1.4)])
    def test_it_takes_as_long_as_the_trapezoid_of_its_leading_axis(self, way, v, a):
        goal = START + np.array([0.1, -0.2, way, 0.0, 0.3 * way, -way])
        expected = way / v + v / a if way > v * v / a else 2 * np.sqrt(way / a)
        assert (len(play(movej(goal, v, a, CB3))) - 1) * CB3 == pytest.approx(expected, abs=CB3)

    def test_the_slider_stretches_its_time(self):
        goal = START + 0.8
        full = len(play(movej(goal, 1.0, 1.4, CB3)))
        slow = play(movej(goal, 1.0, 1.4, CB3), sliders=[(10**6, 0.1)])
        assert len(slow) == pytest.approx(10 * full, rel=0.01)
        assert np.abs(slow[:, 1]).max() == pytest.approx(0.1, rel=1e-6)

    def test_a_closed_slider_holds_it_and_an_open_one_lets_it_go_on(self):
        goal = START + 0.8
        path = play(movej(goal, 1.0, 1.4, CB3), sliders=[(90, 1.0), (400, 0.0)])
        held = path[350:480]
        assert not held[:, 1].any()
        assert (held[:, 0] == held[0, 0]).all()
        assert path[-1, 0] == pytest.approx(goal, abs=1e-12)

    def test_a_time_takes_precedence_over_speed_and_acceleration(self):
        path = play(movej(START + 0.3, 3.0, 15.0, CB3, time_s=2.0))
        assert (len(path) - 1) * CB3 == pytest.approx(2.0, abs=CB3)

    def test_no_joint_gets_faster_than_the_arm_can(self):
        arm = load_arm("ur10")
        path = play(movej(START + np.array([0.0, 1.0, 0, 0, 0, 2.0]), 3.1, 40.0, CB3, arm=arm))
        assert (np.abs(path[:, 1]).max(axis=0) <= arm.qd_max * ROUNDING).all()
        assert (np.abs(path[:, 2]).max(axis=0) <= arm.qdd_max * ROUNDING).all()

    def test_an_arm_that_moves_brakes_before_it_sets_off(self):
        qd = np.array([0.5, -1.0, 0, 0, 0, 0])
        path = play(movej(START + 1, 1.0, 2.0, CB3), qd=qd)
        rest = int(np.flatnonzero(~path[:, 1].any(axis=1))[0])
        assert rest * CB3 == pytest.approx(1.0 / 8.0, abs=CB3)
        assert path[-1, 0] == pytest.approx(START + 1, abs=1e-12)

    def test_being_there_already_it_is_over(self):
        assert len(play(movej(START, 1.0, 1.0, CB3))) == 1

    def test_a_target_beyond_the_joint_limits_is_refused_before_it_moves(self):
        motion = movej(START + np.array([0, 0, 0, 0, 0, 9.0]), 1.0, 1.0, CB3, arm=ARM)
        with pytest.raises(MotionImpossible, match="joint 6") as caught:
            motion.advance(standing(START), 1.0)
        assert caught.value.code == JOINT_LIMITS

    @pytest.mark.parametrize(("v", "a"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (np.nan, 1.0)])
    def test_without_speed_or_acceleration_it_leads_nowhere(self, v, a):
        with pytest.raises(MotionImpossible) as caught:
            movej(START + 1, v, a, CB3).advance(standing(START), 1.0)
        assert caught.value.code == 0

    def test_to_a_pose_it_goes_to_the_nearest_posture(self):
        goal = START + np.array([0.3, 0.2, -0.3, 0.1, 0.2, -0.4])
        path = play(movej_to_pose(ARM, TCP, pose_of(ARM, goal, TCP), 1.0, 1.0, CB3))
        assert path[-1, 0] == pytest.approx(goal, abs=1e-9)


class TestMoveL:
    @pytest.mark.thorough
    @given(step=STEPS, v=st.floats(0.1, 0.4), a=st.floats(0.5, 2.0), sliders=SLIDERS, tick=RATES)
    @settings(max_examples=15, deadline=None)
    def test_the_tool_stays_on_its_line_and_keeps_speed_and_acceleration(
        self, step, v, a, sliders, tick
    ):
        begin = pose_of(ARM, START, TCP)
        goal = moved(begin, step)
        path = play(movel(ARM, TCP, goal, v, a, tick), tick=tick, sliders=sliders)
        poses, twists = tool_of(path)
        along = poses[:, :3] - begin[:3]
        length = np.linalg.norm(step[:3])
        direction = step[:3] / length if length > 0 else np.zeros(3)
        aside = along - np.outer(along @ direction, direction)
        assert np.abs(aside).max() < 1e-9
        assert np.linalg.norm(twists[:, :3], axis=1).max() <= v * ROUNDING
        assert np.linalg.norm(twists[:, 3:], axis=1).max() <= 4 * v * ROUNDING
        changes = np.diff(twists, axis=0) / tick
        assert np.linalg.norm(changes[:, :3], axis=1).max(initial=0.0) <= a * ROUNDING + 1e-6
        assert poses[-1, :3] == pytest.approx(goal[:3], abs=1e-9)
        assert turn_between(poses[-1], goal) < 1e-9
        assert at_rest(path[-1])

    def test_it_turns_about_one_axis_in_step_with_its_way(self):
        begin = pose_of(ARM, START, TCP)
        step = np.array([0.1, -0.1, 0.05, 0.3, -0.2, 0.4])
        path = play(movel(ARM, TCP, moved(begin, step), 0.25, 1.2, CB3))
        poses, _ = tool_of(path)
        share = (poses[:, :3] - begin[:3]) @ step[:3] / (step[:3] @ step[:3])
        for pose, part in zip(poses[::10], share[::10], strict=True):
            assert turn_between(moved(begin, part * step), pose) < 1e-9

    def test_joint_speeds_are_those_of_the_joint_positions(self):
        step = np.array([0.1, -0.1, 0.05, 0.3, -0.2, 0.4])
        path = play(movel(ARM, TCP, moved(pose_of(ARM, START, TCP), step), 0.25, 1.2, E_SERIES))
        speeds, _ = steps_of(path, E_SERIES)
        assert speeds == pytest.approx((path[1:, 1] + path[:-1, 1]) / 2, abs=1e-3)

    def test_a_target_out_of_reach_is_a_runtime_error_before_it_moves(self):
        with pytest.raises(MotionImpossible, match="unable to find a solution") as caught:
            movel(ARM, TCP, [1.5, 0, 0, 0, 0, 0], 0.25, 1.2, CB3).advance(standing(START), 1.0)
        assert caught.value.code == 0

    def test_a_way_past_the_pan_axis_is_a_singularity_found_on_the_way(self):
        begin = pose_of(ARM, START, TCP)
        path, error = until_impossible(movel(ARM, TCP, [*-begin[:2], *begin[2:]], 0.25, 1.2, CB3))
        assert error.code == SINGULARITY
        assert "singularity" in error.text
        speeds, _ = steps_of(path, CB3)
        assert len(path) > 100
        assert (np.abs(speeds).max(axis=0) <= ARM.qd_max * 1.01).all()


def joint_legs(radius, v=1.05, a=1.4):
    random = np.random.default_rng(3)
    goals = START + random.uniform(-0.6, 0.6, (5, 6))
    return [Leg("j", q, v, a, radius=radius) for q in goals]


def tool_legs(radius, kind="l", v=0.25, a=1.2):
    random = np.random.default_rng(4)
    begin = pose_of(ARM, START, TCP)
    steps = np.hstack((random.uniform(-0.12, 0.12, (5, 3)), random.uniform(-0.3, 0.3, (5, 3))))
    return [Leg(kind, moved(begin, s), v, a, radius=radius, is_pose=True) for s in steps]


def path_of(legs, **options):
    motion, progress = MovePath(ARM, TCP, legs, CB3), []
    advance = motion.advance

    def noted(now, scale):
        after = advance(now, scale)
        progress.append(motion.progress)
        return after

    motion.advance = noted
    return play(motion, **options), progress


def nearest_to(poses, waypoint):
    return np.linalg.norm(poses[:, :3] - waypoint[:3], axis=1)


class TestPaths:
    @pytest.mark.thorough
    @pytest.mark.parametrize("legs", [joint_legs(0.0), tool_legs(0.0), tool_legs(0.0, "p")])
    def test_without_a_radius_it_stops_at_every_waypoint(self, legs):
        path, _ = path_of(legs)
        for leg in legs:
            at = pose_of(ARM, leg.target, TCP) if leg.kind == "j" else leg.target
            poses, twists = tool_of(path)
            closest = nearest_to(poses, at).argmin()
            assert nearest_to(poses, at)[closest] < 1e-3
            assert np.linalg.norm(twists[closest, :3]) < 0.02

    @pytest.mark.parametrize("legs", [joint_legs(0.04), tool_legs(0.02)])
    def test_with_a_radius_it_passes_within_it_and_does_not_stop(self, legs):
        path, _ = path_of(legs)
        poses, _ = tool_of(path)
        for leg in legs[:-1]:
            at = pose_of(ARM, leg.target, TCP) if leg.kind == "j" else leg.target
            assert nearest_to(poses, at).min() < leg.radius
        assert np.abs(path[1:-1, 1]).max(axis=1).min() > 0.005
        stopping, _ = path_of([Leg(**{**_fields(leg), "radius": 0.0}) for leg in legs])
        assert len(path) < len(stopping)

    @given(radius=st.floats(0.0, 0.3), seed=st.integers(0, 10**6), sliders=SLIDERS)
    @settings(max_examples=12, deadline=None)
    def test_blended_joint_moves_keep_speed_and_acceleration(self, radius, seed, sliders):
        random = np.random.default_rng(seed)
        legs = [
            Leg("j", START + random.uniform(-0.8, 0.8, 6), v, a, radius=radius)
            for v, a in random.uniform(0.5, 2.0, (4, 2))
        ]
        path, _ = path_of(legs, sliders=sliders)
        v, a = max(leg.v for leg in legs), max(leg.a for leg in legs)
        speeds, accelerations = steps_of(path, CB3)
        assert np.abs(speeds).max() <= v * ROUNDING
        assert np.abs(accelerations).max() <= a * ROUNDING
        assert path[-1, 0] == pytest.approx(legs[-1].target, abs=1e-9)
        assert at_rest(path[-1])

    @pytest.mark.thorough
    @given(radius=st.floats(0.0, 0.1), seed=st.integers(0, 10**6), sliders=SLIDERS)
    @settings(max_examples=12, deadline=None)
    def test_blended_tool_moves_keep_speed_and_acceleration(self, radius, seed, sliders):
        random = np.random.default_rng(seed)
        begin = pose_of(ARM, START, TCP)
        legs = []
        for v, a in random.uniform((0.1, 0.5), (0.3, 1.5), (3, 2)):
            target = moved(begin, random.uniform(-0.1, 0.1, 6))
            legs.append(Leg("l", target, v, a, radius=radius, is_pose=True))
        path, _ = path_of(legs, sliders=sliders)
        poses, twists = tool_of(path)
        v, a = max(leg.v for leg in legs), max(leg.a for leg in legs)
        assert np.linalg.norm(twists[:, :3], axis=1).max() <= v * ROUNDING
        changes = np.diff(twists[:, :3], axis=0) / CB3
        assert np.linalg.norm(changes, axis=1).max() <= a * ROUNDING + 1e-6
        assert poses[-1, :3] == pytest.approx(legs[-1].target[:3], abs=1e-9)
        assert turn_between(poses[-1], legs[-1].target) < 1e-9

    @pytest.mark.parametrize("legs", [joint_legs(0.04), tool_legs(0.0), tool_legs(0.02, "p")])
    def test_progress_counts_the_moves(self, legs):
        _, progress = path_of(legs)
        assert progress == sorted(progress)
        assert set(progress) == set(range(len(legs)))

    def test_between_spaces_it_stops_and_goes_on(self):
        first, second = tool_legs(0.02)[0], joint_legs(0.02)[0]
        legs = [first, second, tool_legs(0.02)[1]]
        path, progress = path_of(legs)
        poses, _ = tool_of(path)
        assert nearest_to(poses, first.target).min() < 1e-9
        assert np.abs(path[:, 0] - second.target).max(axis=1).min() < 1e-9
        assert nearest_to(poses, legs[2].target)[-1] < 1e-9
        assert set(progress) == {0, 1, 2}

    def test_the_same_path_is_the_same_to_the_last_bit(self):
        first, _ = path_of(tool_legs(0.02), sliders=[(50, 0.3)])
        again, _ = path_of(tool_legs(0.02), sliders=[(50, 0.3)])
        assert (first == again).all()

    def test_an_empty_path_is_over(self):
        assert len(path_of([])[0]) == 1

    @pytest.mark.thorough
    def test_hundreds_of_waypoints_are_blended_in_one_plan(self):
        random = np.random.default_rng(5)
        legs = [
            Leg("j", START + random.uniform(-0.3, 0.3, 6), 3.0, 13.0, radius=0.02)
            for _ in range(300)
        ]
        path, _ = path_of(legs, limit_s=300.0)
        assert path[-1, 0] == pytest.approx(legs[-1].target, abs=1e-9)


def _fields(leg):
    return {name: getattr(leg, name) for name in leg.__dataclass_fields__}


def fourier(t):
    """A smooth trajectory of six joints that begins at rest, up to 1.1 rad/s."""
    k = np.arange(1, 6)[:, None]
    phase = np.linspace(0.0, 2.0, 6)
    wave = np.sin(2 * np.pi * 0.1 * k * t + phase) / k
    return START + 0.35 * min(1.0, t / 2) ** 3 * wave.sum(axis=0)


def served(lookahead, gain, seconds=10.0, tick=CB3):
    """Set-points while a target is streamed, and after that until rest."""
    servo, path, now = ServoJ(tick, ARM), [], standing(fourier(0.0))
    for k in range(round(seconds / tick)):
        servo.aim(fourier(k * tick), tick, lookahead, gain)
        now = servo.advance(now, 1.0)
        path.append(now)
    streamed = len(path)
    while (now := servo.advance(now, 1.0)) is not None:
        path.append(now)
        assert len(path) < 10**5
    return np.array(path), streamed


class TestServoJ:
    @pytest.mark.thorough
    @pytest.mark.parametrize(
        ("lookahead", "gain", "lag"),
        [(0.03, 300, 0.03), (0.1, 300, 0.1), (0.2, 300, 0.2), (0.1, 1200, 0.05), (0.1, 100, 0.173)],
    )
    def test_it_follows_a_fourier_trajectory_with_the_documented_lag(self, lookahead, gain, lag):
        path, streamed = served(lookahead, gain)
        times = np.arange(streamed) * CB3
        target_speed = np.gradient(np.array([fourier(t) for t in times]), CB3, axis=0)
        behind = np.array([fourier(t) for t in times]) - path[:streamed, 0]
        late = np.sum(behind * target_speed) / np.sum(target_speed**2)
        assert late == pytest.approx(lag, abs=CB3 + 0.15 * lag)
        moved_back = np.array([fourier(max(t - late, 0.0)) for t in times])
        assert np.abs(path[:streamed, 0] - moved_back).max() < 0.35 * lag

    def test_when_the_aims_stop_it_comes_to_rest_at_the_last_one(self):
        path, streamed = served(0.03, 300)
        assert path[-1, 0] == pytest.approx(fourier((streamed - 1) * CB3), abs=1e-12)
        assert at_rest(path[-1])
        assert (len(path) - streamed) * CB3 < 1.0

    @pytest.mark.thorough
    @given(
        goal=GOALS,
        lookahead=st.floats(0.03, 0.2),
        gain=st.floats(100, 2000),
        tick=RATES,
        sliders=SLIDERS,
    )
    @settings(max_examples=20, deadline=None)
    def test_it_never_swings_beyond_a_target_that_stands_still(
        self, goal, lookahead, gain, tick, sliders
    ):
        servo = ServoJ(tick, ARM)
        servo.aim(goal, tick, lookahead, gain)
        path = play(servo, tick=tick, sliders=sliders)
        passed = (path[:, 0] - goal) * np.sign(START - goal)
        assert passed.min() > -1e-6
        assert path[-1, 0] == pytest.approx(goal, abs=1e-9)
        assert (np.abs(path[:, 1]).max(axis=0) <= ARM.qd_max * ROUNDING).all()
        speeding_up = np.diff(np.abs(path[:, 1]), axis=0) / tick
        assert speeding_up.max() <= 40.0 * ROUNDING

    def test_the_slider_limits_its_speed(self):
        servo = ServoJ(CB3, ARM)
        servo.aim(START + 1.0, CB3, 0.05, 300)
        path = play(servo, sliders=[(10**6, 0.1)])
        assert np.abs(path[:, 1]).max() <= 0.1 * np.pi * ROUNDING

    def test_a_closed_slider_brakes_it_no_harder_than_the_arm_brakes(self):
        servo = ServoJ(CB3, ARM)
        servo.aim(START + 2.0, CB3, 0.1, 300)
        now, path = standing(START), []
        for k in range(200):
            now = servo.advance(now, 1.0 if k < 30 else 0.0)
            path.append(now)
        path = np.array(path)
        assert path[29, 1].max() > 2.0
        assert path[-1, 1] == pytest.approx(0.0, abs=1e-6)
        assert steps_of(path[30:], CB3)[1].min() > -20.0

    def test_a_target_beyond_the_joint_limits_is_refused(self):
        servo = ServoJ(CB3, ARM)
        servo.aim(START + np.array([7, 0, 0, 0, 0, 0]), CB3, 0.1, 300)
        with pytest.raises(MotionImpossible) as caught:
            servo.advance(standing(START), 1.0)
        assert caught.value.code == JOINT_LIMITS

    @pytest.mark.parametrize(
        "numbers", [(np.nan, 0.1, 300), (0.008, np.nan, 300), (0.008, 0.1, np.inf)]
    )
    def test_what_is_no_number_is_refused(self, numbers):
        servo = ServoJ(CB3, ARM)
        servo.aim(START, *numbers)
        with pytest.raises(MotionImpossible) as caught:
            servo.advance(standing(START), 1.0)
        assert caught.value.code == SUDDEN_CHANGE

    def test_without_an_aim_it_brakes(self):
        path = play(ServoJ(CB3, ARM), qd=np.full(6, 0.4))
        assert not path[-1, 1].any()
        assert np.abs(steps_of(path, CB3)[1]).max() <= 8.0 * ROUNDING


class TestSpeeds:
    @given(qd=st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6).map(np.array), a=ACCELERATIONS)
    @settings(max_examples=15, deadline=None)
    def test_speedj_speeds_up_with_its_acceleration_and_goes_on(self, qd, a):
        motion, path = SpeedJ(CB3, ARM), [standing(START)]
        for _ in range(round(np.abs(qd).max() / a / CB3) + 5):
            motion.aim(qd, a)
            path.append(motion.advance(path[-1], 1.0))
        path = np.array(path)
        assert (path[-3:, 1] == qd).all()
        assert np.abs(steps_of(path, CB3)[1]).max() <= a * ROUNDING

    def test_speedj_follows_the_slider(self):
        motion, now = SpeedJ(CB3, ARM), standing(START)
        motion.aim([0.5, 0, 0, 0, 0, -1.0], 5.0)
        for _ in range(100):
            now = motion.advance(now, 0.25)
        assert now[1] == pytest.approx([0.125, 0, 0, 0, 0, -0.25])

    def test_speedj_ends_where_it_can_still_stop_within_the_joint_limits(self):
        motion = SpeedJ(CB3, ARM)
        motion.aim([0, 0, 0, 0, 0, 3.0], 5.0)
        path, error = until_impossible(motion)
        assert error.code == JOINT_LIMITS
        assert "joint 6" in error.text
        stopped = play(StopJoints(8.0, CB3), start=path[-1, 0], qd=path[-1, 1])[-1, 0]
        assert ARM.q_max[5] - 0.1 < stopped[5] <= ARM.q_max[5]

    def test_speedl_moves_the_tool_straight_with_its_acceleration(self):
        xd = np.array([0.08, -0.05, 0.02, 0.0, 0.0, 0.3])
        motion, now, path = SpeedL(ARM, TCP, E_SERIES), standing(START), [standing(START)]
        motion.aim(xd, 0.5)
        for _ in range(600):
            now = motion.advance(now, 1.0)
            path.append(now)
        poses, twists = tool_of(np.array(path))
        assert twists[-1] == pytest.approx(xd, abs=1e-5)
        direction = xd[:3] / np.linalg.norm(xd[:3])
        along = poses[:, :3] - poses[0, :3]
        assert np.abs(along - np.outer(along @ direction, direction)).max() < 1e-5
        assert np.linalg.norm(np.diff(twists[:, 3:], axis=0), axis=1).max() <= 0.5 * E_SERIES * 1.01

    def test_speedl_ends_at_a_singularity(self):
        motion = SpeedL(ARM, TCP, CB3)
        motion.aim([0.2, 0, 0, 0, 0, 0], 1.0)
        _, error = until_impossible(motion)
        assert error.code == SINGULARITY


class TestStops:
    @pytest.mark.thorough
    @given(qd=st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array), a=ACCELERATIONS)
    def test_stopj_keeps_the_direction_and_its_deceleration(self, qd, a):
        path = play(StopJoints(a, CB3), qd=qd)
        fastest = np.abs(qd).max()
        assert (len(path) - 1) * CB3 == pytest.approx(fastest / a, abs=1.01 * CB3)
        assert np.abs(steps_of(path, CB3)[1]).max(initial=0.0) <= a * ROUNDING
        assert not path[-1, 1].any()

    def test_stopl_stops_the_tool_on_its_line(self):
        tick, speed = E_SERIES, np.array([0.15, -0.1, 0.05, 0, 0, 0])
        motion, now = SpeedL(ARM, TCP, tick), standing(START)
        motion.aim(speed, 50.0)
        for _ in range(20):
            now = motion.advance(now, 1.0)
        path = play(StopL(ARM, TCP, 0.8, tick), start=now[0], qd=now[1], tick=tick)
        poses, twists = tool_of(path)
        along = poses[:, :3] - poses[0, :3]
        direction = speed[:3] / np.linalg.norm(speed[:3])
        assert np.abs(along - np.outer(along @ direction, direction)).max() < 1e-5
        assert np.linalg.norm(speed) / 0.8 == pytest.approx(len(path) * tick, abs=3 * tick)
        changes = np.linalg.norm(np.diff(twists[:, :3], axis=0), axis=1) / tick
        assert changes.max() <= 0.8 * 1.02

    @given(q=GOALS, qd=st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array))
    @settings(max_examples=25, deadline=None)
    def test_stopl_stops_from_anywhere_even_in_a_singularity(self, q, qd):
        for start in (q, np.radians([0.0, -90, 0, -90, 0, 0]), np.zeros(6)):
            path = play(StopL(ARM, TCP, 1.5, CB3), start=start, qd=qd, limit_s=20.0)
            assert not path[-1, 1].any()
            assert np.abs(path[:, 1]).max() <= np.abs(qd).max() * ROUNDING


def test_pose_trans_is_what_moved_does_in_these_tests():
    pose, turn = pose_of(ARM, START, TCP), np.array([0, 0, 0, 0.1, 0.2, 0.3])
    assert pose_trans(pose, turn) == pytest.approx(moved(pose, turn), abs=1e-12)
