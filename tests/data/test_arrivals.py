"""How a joint came to rest is seen in its positions, at any rate, and stays with its dwell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.data import Conditions, Dataset
from hil.data.arrivals import (
    ARRIVAL_POINTS,
    ARRIVAL_Q,
    ARRIVAL_QD,
    NEAR_RAD,
    Track,
    approach_directions,
    arrival,
)
from hil.data.dataset import rows_of
from hil.data.dwells import dwells_of
from hil.data.splits import split
from hil.importers.series import Origin, StepNote, assemble, cut
from hil.robot import Status
from hil.robot.state import state_topic
from tests.support.synthetic_motion import arriving, moving

STOP_S, SLIDE_RAD, DECELERATION = 0.4, 2e-4, 1.4
REST_FROM, REST_UNTIL = 0.9, 1.0


def stopping(t, late_s=0.0):
    """Joint 1 from below, joint 2 from above: into rest at 0.3 rad, and slide back."""
    before = np.minimum(t - STOP_S - late_s, 0.0)
    back = np.clip((t - STOP_S - late_s) / 0.05, 0.0, 1.0)
    way = -0.5 * DECELERATION * before**2 + SLIDE_RAD * (1.0 - back**2 * (3.0 - 2.0 * back))
    return 0.3 + np.stack([way, -way], axis=1)


def track(rate_hz, late_s=0.0, noise_rad=0.0, until_s=1.1):
    t = np.arange(round(until_s * rate_hz)) / rate_hz
    q = stopping(t, late_s)
    noise = noise_rad * np.random.default_rng(3).normal(size=q.shape)
    return Track(t, q + noise, np.gradient(q, t, axis=0))


def path(rate_hz=125.0, **changes):
    return arrival(track(rate_hz, **changes), REST_FROM, REST_UNTIL)


def without(motion, keep):
    return Track(motion.t[keep], motion.q[keep], motion.qd[keep])


def test_a_path_begins_near_rest_and_holds_overshoot_and_slide_back() -> None:
    found = path()
    assert found.shape == (ARRIVAL_POINTS, 2, 2)
    assert found[0, ARRIVAL_Q] == pytest.approx([-NEAR_RAD, NEAR_RAD], rel=1e-6)
    assert found[:, ARRIVAL_Q, 0].max() == pytest.approx(SLIDE_RAD, rel=0.05)
    assert found[-1] == pytest.approx(0.0, abs=1e-9)
    assert found[0, ARRIVAL_QD, 0] == pytest.approx(np.sqrt(2 * DECELERATION * 1.2e-3), rel=0.05)


@pytest.mark.parametrize("late_s", [0.0, 0.003, 0.0051])
def test_the_path_does_not_depend_on_rate_or_phase_of_the_samples(late_s) -> None:
    fine = path(2000.0)
    for rate_hz in (125.0, 500.0):
        # The encoders of arms resolve 2e-5 rad.
        assert path(rate_hz, late_s=late_s)[:, ARRIVAL_Q] == pytest.approx(
            fine[:, ARRIVAL_Q], abs=1e-5
        )


def test_encoder_noise_is_averaged_at_dense_samples() -> None:
    clean, noisy = path(500.0)[6:, ARRIVAL_Q], path(500.0, noise_rad=2e-5)[6:, ARRIVAL_Q]
    assert np.std(noisy - clean) < 1.3e-5


def test_directions_are_those_the_joints_came_in() -> None:
    assert approach_directions(np.stack([path(), path()])).tolist() == [[1.0, -1.0]] * 2


def test_a_joint_that_did_not_move_lately_is_found_further_back() -> None:
    early = track(125.0, until_s=1.1)
    t = np.arange(10 * 125) / 125
    q = np.stack([np.interp(t, early.t, early.q[:, 0]), 0.3 - 0.1 * np.cos(t)], axis=1)
    both = Track(t, q, np.zeros_like(q))
    later = arrival(both, 9.5, 9.7)
    assert later[:, ARRIVAL_Q, 0] == pytest.approx(path()[:, ARRIVAL_Q, 0], abs=1e-12)


def test_a_joint_that_never_moved_has_no_path() -> None:
    motion = track(125.0)
    motion.q[:, 1] = 0.3
    found = arrival(motion, REST_FROM, REST_UNTIL)
    assert np.all(np.isnan(found[:, :, 1]))
    assert np.all(np.isfinite(found[:, :, 0]))
    assert approach_directions(found[None]).tolist() == [[1.0, 0.0]]


def test_what_lies_behind_a_gap_is_not_known() -> None:
    motion = track(125.0)
    gap = (motion.t > 0.6) & (motion.t < 0.66)
    assert np.all(np.isnan(arrival(without(motion, ~gap), REST_FROM, REST_UNTIL)))


def test_a_gap_before_the_last_millirad_does_no_harm() -> None:
    motion = track(125.0)
    gap = (motion.t > 0.1) & (motion.t < 0.3)
    found = arrival(without(motion, ~gap), REST_FROM, REST_UNTIL)
    assert found == pytest.approx(path(), abs=1e-12)


def test_a_lost_sample_is_bridged() -> None:
    motion = track(125.0)
    lost = np.arange(len(motion.t)) != round(0.424 * 125)
    found = arrival(without(motion, lost), REST_FROM, REST_UNTIL)
    assert found[:, ARRIVAL_Q] == pytest.approx(path()[:, ARRIVAL_Q], abs=2e-5)


def recording(segments, order=None):
    """Rows of a UR at 125 Hz whose joints stop as above, cut into a move and a dwell."""
    motion = track(125.0)
    rows = state_topic(2, 125.0, clock="virtual", effort_unit="A").blank(len(motion.t))
    rows["device_time"], rows["q"], rows["qd"] = motion.t, motion.q, motion.qd
    rows["effort"] = 0.0
    rows["segment"] = np.where(motion.t < 0.5, *segments)
    return rows if order is None else rows[order]


def loaded(rows):
    notes = {1: StepNote("move"), 2: StepNote("dwell", pose=0, approach=1)}
    origin = Origin("run", "two", ("a", "b"), "current", None, "")
    return assemble(cut(rows, notes, 0), origin, 10)


def test_a_recording_knows_the_arrival_of_its_dwells_only() -> None:
    data = loaded(recording((1, 2)))
    assert [c.kind for c in data.conditions] == ["move", "dwell"]
    assert np.all(np.isnan(data.arrivals[0]))
    assert data.arrivals[1] == pytest.approx(path(), abs=1e-6)


def test_repeated_and_unusable_rows_change_nothing() -> None:
    once = recording((1, 2))
    twice = once[np.repeat(np.arange(len(once)), 2)]
    twice["q"][1::2] = np.nan
    masked = once[60:62].copy()
    masked["status"] = int(Status.MASKED)
    masked["q"] = 9.0
    masked["device_time"] += 0.001
    rows = np.concatenate([twice[:122], masked[:1], twice[122:]])
    assert loaded(rows).arrivals[1] == pytest.approx(loaded(once).arrivals[1], abs=1e-12)


def test_selected_and_split_dwells_keep_their_own_arrivals() -> None:
    data = arriving(12)
    parts = split(data, "pose", 0.25, seed=1)
    known = dict(zip((c.id for c in data.conditions), data.arrivals, strict=True))
    for part in (parts.train, parts.test, dwells_of(data), data.take([3, 0])):
        assert part.conditions
        for condition, own in zip(part.conditions, part.arrivals, strict=True):
            assert own is not None
            assert np.array_equal(own, known[condition.id])


def test_rows_left_out_leave_the_arrivals_of_their_series() -> None:
    data = arriving(3)
    thinned = rows_of(data, np.arange(len(data)) % 3 == 0)
    assert np.array_equal(thinned.arrivals, data.arrivals)


def test_pooled_data_keep_the_arrivals_there_are() -> None:
    dwells, trajectory = arriving(2), moving(1, samples=50)
    common = replace(trajectory, columns={n: trajectory[n] for n in ("t", "q", "effort")})
    pooled = Dataset.concatenate([common, dwells])
    assert np.all(np.isnan(pooled.arrivals[0]))
    assert np.array_equal(pooled.arrivals[1:], dwells.arrivals)
    assert Dataset.concatenate([common, common]).arrivals is None


def test_arrivals_of_another_number_of_series_are_refused() -> None:
    data = arriving(2)
    with pytest.raises(DataError, match="arrivals do not match"):
        replace(data, arrivals=data.arrivals[:1])


def test_stays_found_in_a_motion_have_no_arrival() -> None:
    still = replace(
        arriving(1),
        conditions=(Conditions("all", "trajectory"),),
        offsets=np.array([0, 20]),
        arrivals=None,
    )
    assert dwells_of(still).arrivals is None
