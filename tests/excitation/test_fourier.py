"""Fourier excitation: feasible to the last sample, at rest at both ends, decided by the seed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.core.errors import PlanError
from hil.core.typing import FloatArray
from hil.excitation.fourier import FourierExcitation, fitting_frequency
from hil.excitation.motion import Motion
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace, roomy_poses
from hil.spec.experiment import Fourier
from tests.support.plan_parts import DEGREE, toy_workspace

RATE = 100.0
CLEAR = toy_workspace()
CLEAR_ROADMAP = Roadmap(CLEAR, roomy_poses(CLEAR, 16, seed=0))


def series_of(roadmap: Roadmap = CLEAR_ROADMAP, **changes: Any) -> list[Motion]:
    facts: dict[str, Any] = {"kind": "fourier", "trajectories": 1, "amplitude_deg": 60.0}
    spec = Fourier.model_validate(facts | changes)
    visits = FourierExcitation(spec).program(roadmap).visits
    return [motion for visit in visits for motion in visit.motions]


def roadmap_in(workspace: Workspace) -> Roadmap:
    return Roadmap(workspace, roomy_poses(workspace, 16, seed=0))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 8), st.floats(0.05, 0.4))
def test_limits_range_and_amplitude_are_kept_on_a_grid_ten_times_denser(
    seed: int, harmonics: int, fundamental_hz: float
) -> None:
    (motion,) = series_of(seed=seed, harmonics=harmonics, fundamental_hz=fundamental_hz)
    dense = motion.sample(10 * RATE)
    assert np.abs(dense.qd).max() <= CLEAR.velocity + 1e-9
    assert np.abs(dense.qdd).max() <= CLEAR.acceleration + 1e-9
    assert np.all((dense.q >= CLEAR.low - 1e-9) & (dense.q <= CLEAR.high + 1e-9))
    assert np.abs(dense.q - motion.to_dict()["q0_rad"]).max() <= 60 * DEGREE + 1e-9


@pytest.mark.thorough
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_trajectories_are_at_rest_at_both_ends(seed: int, periods: int) -> None:
    (motion,) = series_of(seed=seed, periods=periods)
    samples = motion.sample(RATE)
    assert np.abs(samples.qd[-1]).max() <= 1e-9
    assert np.abs(samples.qdd[-1]).max() <= 1e-9
    first = motion.sample(1e4)
    # The jerk is finite at t = 0, so velocity and acceleration grow from zero.
    assert np.abs(first.qd[0]).max() <= 1e-6
    assert np.abs(first.qdd[0]).max() <= 1e-2
    np.testing.assert_allclose(samples.q[-1], motion.q_start, atol=1e-9)


def test_each_joint_gets_close_to_one_of_its_limits() -> None:
    (motion,) = series_of(seed=1)
    dense = motion.sample(10 * RATE)
    shares = [
        np.abs(dense.qd).max(axis=0) / CLEAR.velocity,
        np.abs(dense.qdd).max(axis=0) / CLEAR.acceleration,
        np.ptp(dense.q, axis=0) / (CLEAR.high - CLEAR.low),
        np.abs(dense.q - motion.to_dict()["q0_rad"]).max(axis=0) / (60 * DEGREE),
    ]
    assert np.all(np.max(shares, axis=0) >= 0.69)


def test_every_sample_keeps_its_distance() -> None:
    def disc(q: FloatArray) -> FloatArray:
        return np.hypot(q[:, 0] - 0.3, q[:, 1]) - 0.5

    motions = series_of(roadmap_in(toy_workspace(disc)), trajectories=4)
    assert min(disc(motion.sample(RATE).q).min() for motion in motions) >= 0.02


def test_the_best_conditioned_of_several_draws_is_kept() -> None:
    scores: list[float] = []

    def condition(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> float:
        scores.append(1.0 / float(np.abs(qd).mean()))
        return scores[-1]

    (motion,) = series_of(roadmap_in(toy_workspace(condition=condition)))
    assert len(scores) >= 5
    speed = np.abs(motion.sample(100 * motion.to_dict()["fundamental_hz"]).qd).mean()
    assert 1.0 / speed == pytest.approx(min(scores))


def test_the_seed_decides() -> None:
    first, again, other = (series_of(seed=seed, trajectories=2) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    assert first[0] != first[1]


@pytest.mark.parametrize(("asked_hz", "rate_hz"), [(0.1, 125.0), (0.13, 125.0), (0.07, 94.0)])
def test_the_period_is_stretched_to_whole_samples(asked_hz: float, rate_hz: float) -> None:
    spec = Fourier(kind="fourier", fundamental_hz=asked_hz, periods=3)
    got = fitting_frequency(spec, rate_hz)
    samples = 3 * rate_hz / got
    assert samples == pytest.approx(round(samples), abs=1e-6)
    assert 0 <= 3 / got - 3 / asked_hz < 1 / rate_hz


def test_no_room_for_any_series_is_said() -> None:
    comb = toy_workspace(lambda q: np.where(np.abs(q[:, 0]) < 0.02, 0.1, -0.1))
    alley = Roadmap(comb, np.array([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]]))
    with pytest.raises(PlanError, match="random Fourier series keep 20 mm") as error:
        series_of(alley)
    assert "amplitude_deg" in error.value.hint
