"""Errors of loads, of their declarations' check, and of gains, over many noises; minutes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from hil.data import Dataset
from hil.estimators.drive_gains import controller_gains
from hil.estimators.payload import estimate_payload, true_values
from hil.estimators.payload_declaration import FALSE_ALARM, check_declarations
from hil.estimators.rigid_linear import RigidWls
from tests.support.load_parts import BELIEVED, OFF_AXIS, QUIET_A, estimates, logged, under_load
from tests.support.synthetic_motion import LOAD, moving, nominal

pytestmark = [pytest.mark.proof, pytest.mark.timeout(600)]


def noisy(data: Dataset, seed: int, correlation: float) -> Dataset:
    white = np.random.default_rng(seed).normal(size=data["effort"].shape)
    scaled = QUIET_A * np.sqrt(1 - correlation**2) * white
    effort = data["effort"] + lfilter([1.0], [1.0, -correlation], scaled, axis=0)
    return data.with_columns(effort=effort, effort_f=effort)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_intervals_of_a_load_hold_the_truth_as_often_as_they_say(correlation: float) -> None:
    truth = true_values(LOAD)
    known = RigidWls().fit(moving(1, 2, 3), nominal())
    known.samples_ = 10**9  # an arm that is known exactly: what is left are the load's own errors
    inside = []
    for seed in range(100, 160):
        data = noisy(under_load(seed, noise_a=0.0), seed, correlation)
        found = estimate_payload(known, data)
        inside.append((found.interval[:, 0] <= truth) & (truth <= found.interval[:, 1]))
    print(correlation, np.mean(inside, axis=0))  # noqa: T201
    assert 0.92 <= np.mean(inside) <= 1.0


def test_standard_errors_of_gains_know_that_control_errors_last() -> None:
    found = [controller_gains(logged(seed, noise=0.1)) for seed in range(20, 60)]
    deviations = np.array([(one.gain - BELIEVED)[1:3] / one.gain_error[1:3] for one in found])
    assert 0.7 < np.std(deviations) < 1.4


def test_at_most_two_of_300_correct_declarations_are_called_wrong() -> None:
    found = [one for s in range(200, 300) for one in check_declarations(OFF_AXIS, estimates(s))]
    assert FALSE_ALARM * len(found) < 2
    assert sum(not one.agrees for one in found) <= 2
