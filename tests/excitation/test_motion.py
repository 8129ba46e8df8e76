"""Motions: within limits, at rest at both ends, straight, and unchanged by JSON."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import numpy as np
import pytest
import ruckig
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.core.errors import PlanError
from hil.core.typing import FloatArray
from hil.excitation.motion import FourierSeries, Hold, Line, Motion, motion_from_dict, rest_to_rest

RATE = 125.0
relaxed = settings(max_examples=30, deadline=None)
angle = st.floats(-6.3, 6.3, allow_nan=False)
pose = st.tuples(angle, angle, angle)


@st.composite
def lines(draw: st.DrawFn) -> Line:
    velocity = draw(st.floats(0.05, 6.0))
    acceleration = draw(st.floats(0.1, 20.0))
    jerk = acceleration * draw(st.floats(1.0, 50.0))
    return Line(draw(pose), draw(pose), velocity, acceleration, jerk, RATE)


@st.composite
def series(draw: st.DrawFn) -> FourierSeries:
    rows = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
    a, b = draw(st.tuples(rows, rows)), draw(st.tuples(rows, rows))
    return FourierSeries((0.1, -0.2), a, b, draw(st.floats(0.05, 1.0)), draw(st.integers(1, 3)))


def ruckig_line(line: Line) -> ruckig.Trajectory:
    """The same move planned by ruckig with all joints at once, phase-synchronised."""
    n = len(line.start)
    wanted = ruckig.InputParameter(n)
    wanted.current_position, wanted.target_position = list(line.start), list(line.goal)
    wanted.max_velocity, wanted.max_acceleration = [line.velocity] * n, [line.acceleration] * n
    wanted.max_jerk = [line.jerk] * n
    wanted.synchronization = ruckig.Synchronization.Phase
    found = ruckig.Trajectory(n)
    assert ruckig.Ruckig(n).calculate(wanted, found) in (
        ruckig.Result.Working,
        ruckig.Result.Finished,
    )
    return found


def moving(line: Line) -> bool:
    return line.distance > 1e-6


@relaxed
@given(lines())
def test_a_line_keeps_its_limits_on_a_grid_ten_times_denser(line: Line) -> None:
    samples = line.sample(10 * RATE)
    assert np.abs(samples.qd).max() <= line.velocity + 1e-9
    assert np.abs(samples.qdd).max() <= line.acceleration + 1e-9


@relaxed
@given(lines())
def test_a_line_is_straight_and_never_turns_back(line: Line) -> None:
    way = line.q_end - line.q_start
    share = (line.sample(RATE).q - line.q_start) @ way / max(float(way @ way), 1e-300)
    off = line.sample(RATE).q - (line.q_start + share[:, None] * way)
    assert np.abs(off).max() <= 1e-9
    assert np.all(np.diff(share) >= -1e-9)


@relaxed
@given(lines())
def test_a_line_ends_exactly_at_its_goal_and_at_rest(line: Line) -> None:
    samples = line.sample(RATE)
    assert tuple(samples.q[-1]) == line.goal
    assert not samples.qd[-1].any()
    assert not samples.qdd[-1].any()


@relaxed
@given(lines())
def test_a_line_leaves_its_start_from_rest(line: Line) -> None:
    dense = line.sample(20 * RATE)
    step = dense.t[0]
    assert np.abs(dense.q[0] - line.q_start).max() <= line.jerk * step**3
    assert np.abs(dense.qd[0]).max() <= line.jerk * step**2


@relaxed
@given(lines())
def test_a_line_lasts_a_whole_number_of_command_periods(line: Line) -> None:
    periods = line.duration_s * RATE
    assert periods == pytest.approx(round(periods), abs=1e-9)
    assert len(line.sample(RATE)) == round(periods)


@pytest.mark.thorough
@relaxed
@given(lines().filter(moving))
def test_a_line_is_ruckigs_own_straight_line_stretched_by_less_than_a_period(line: Line) -> None:
    theirs = ruckig_line(line)
    assert 0 <= line.duration_s - theirs.duration + 1e-9 <= 1 / RATE + 2e-9
    samples = line.sample(RATE)
    for t, q in zip(samples.t[::7], samples.q[::7], strict=True):
        expected, _, _ = theirs.at_time(t * theirs.duration / line.duration_s)
        np.testing.assert_allclose(q, expected, atol=2e-9)


@relaxed
@given(lines().filter(moving), st.lists(st.floats(0.001, 0.999), min_size=1))
def test_a_profiles_velocity_and_acceleration_are_the_derivatives(
    line: Line, shares: list[float]
) -> None:
    profile = rest_to_rest(line.distance, line.velocity, line.acceleration, line.jerk)
    t, h = np.array(shares) * profile.duration_s, 1e-6 * profile.duration_s
    (x_before, v_before, _), (_, v, a), (x_after, v_after, _) = (
        profile.at(t + step) for step in (-h, 0.0, h)
    )
    # Second differences are bounded by the jerk, first ones by the rounding of the positions.
    np.testing.assert_allclose((x_after - x_before) / (2 * h), v, atol=line.jerk * h**2 + 1e-14 / h)
    np.testing.assert_allclose((v_after - v_before) / (2 * h), a, atol=line.jerk * h + 1e-14 / h)


@pytest.mark.thorough
@relaxed
@given(lines().filter(moving))
def test_a_lines_samples_are_its_stretched_profile(line: Line) -> None:
    """Velocity shrinks with the stretch, acceleration with its square."""
    profile = rest_to_rest(line.distance, line.velocity, line.acceleration, line.jerk)
    stretch = profile.duration_s / line.duration_s
    samples = line.sample(RATE)
    _, v, a = profile.at(samples.t * stretch)
    np.testing.assert_allclose(np.abs(samples.qd).max(axis=1)[:-1], (stretch * v)[:-1], atol=1e-9)
    hardest = np.abs(samples.qdd).max(axis=1)
    np.testing.assert_allclose(hardest[:-1], np.abs(stretch**2 * a)[:-1], atol=1e-9)


@relaxed
@given(series())
def test_a_fourier_series_velocity_and_acceleration_are_the_derivatives(
    motion: FourierSeries,
) -> None:
    rate = 4000.0 * motion.fundamental_hz
    samples = motion.sample(rate)
    for value, slope in ((samples.q, samples.qd), (samples.qd, samples.qdd)):
        central = (value[2:] - value[:-2]) * rate / 2
        atol = 1e-4 * float(np.abs(slope).max()) + 1e-9
        np.testing.assert_allclose(central, slope[1:-1], atol=atol)


@relaxed
@given(st.one_of(lines(), series(), st.builds(Hold, pose)))
def test_a_motion_survives_json_exactly(motion: Motion) -> None:
    again = motion_from_dict(json.loads(json.dumps(motion.to_dict())))
    assert again == motion
    np.testing.assert_array_equal(again.sample(RATE).q, motion.sample(RATE).q)


@pytest.mark.parametrize("way", [0.0, 1e-15, 1e-10])
def test_no_way_to_go_takes_one_sample(way: float) -> None:
    samples = Line((0.5, way), (0.5, 0.0), 1.0, 2.0, 20.0, RATE).sample(RATE)
    np.testing.assert_array_equal(samples.q, [[0.5, 0.0]])
    assert not samples.qd.any()


@pytest.mark.parametrize("way", [2e-9, 1e-7, 1e-5])
def test_the_shortest_ways_are_planned(way: float) -> None:
    samples = Line((0.0, 0.0), (way, -way), 1.0, 2.0, 20.0, RATE).sample(RATE)
    assert tuple(samples.q[-1]) == (way, -way)


def test_limits_no_profile_keeps_are_refused_with_their_values() -> None:
    with pytest.raises(PlanError, match=r"1 rad within 0 rad/s"):
        rest_to_rest(1.0, 0.0, 1.0, 1.0)


@relaxed
@given(series())
def test_a_fourier_series_is_equation_29(motion: FourierSeries) -> None:
    samples = motion.sample(25.0)
    for row in (0, len(samples) // 3, len(samples) - 1):
        np.testing.assert_allclose(samples.q[row], eq29(motion, samples.t[row]), atol=1e-9)


def eq29(motion: FourierSeries, t: float) -> FloatArray:
    omega = 2 * math.pi * motion.fundamental_hz
    out = []
    for q0, a, b in zip(motion.q0, motion.a, motion.b, strict=True):
        q = q0
        for i in range(1, len(a) + 1):
            q += a[i - 1] / (i * omega) * math.sin(i * omega * t)
            q -= b[i - 1] / (i * omega) * math.cos(i * omega * t)
        out.append(q)
    return np.array(out)


@relaxed
@given(series())
def test_a_fourier_series_starts_and_ends_where_it_says(motion: FourierSeries) -> None:
    np.testing.assert_allclose(motion.q_start, eq29(motion, 0.0), atol=1e-12)
    np.testing.assert_allclose(motion.sample(100.0).q[-1], motion.q_end, atol=1e-9)


def test_holding_is_one_set_point() -> None:
    samples = Hold((0.1, 0.2)).sample(RATE)
    np.testing.assert_array_equal(samples.q, [[0.1, 0.2]])
    assert not samples.qd.any()


def test_a_motion_of_a_later_version_is_refused() -> None:
    with pytest.raises(PlanError, match="'spline'"):
        motion_from_dict({"kind": "spline"})


@settings(max_examples=5, deadline=None)
@given(st.floats(10.0, 1000.0))
def test_set_points_reach_the_end_at_any_rate(rate: float) -> None:
    line = Line((0.0,), (1.0,), 1.0, 2.0, 20.0, RATE)
    samples = line.sample(rate)
    assert samples.t[-1] == line.duration_s
    assert np.diff(samples.t).max(initial=0.0) <= 1 / rate + 1e-9


def test_importing_motions_loads_no_planner() -> None:
    code = "import sys, hil.excitation.motion as m; sys.exit('ruckig' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
