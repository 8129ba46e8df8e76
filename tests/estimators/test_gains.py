"""Drive gains from known loads, on dwells whose currents are known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError
from hil.data import Dataset
from hil.estimators.drive_gains import Gains, calibrate_gains
from tests.estimators.test_static_inverse import K2, bent
from tests.support.synthetic_motion import GAINS, dwelling, nominal, plant

BESIDE = Payload(3.0, (0.05, 0.0, 0.05))
ON_AXIS = Payload(3.0, (0.0, 0.0, 0.05))


def torque_of(current, k2):
    """Eq. 16 without offset."""
    return k2 * current * np.abs(current) + GAINS * current


def sweep(*loads, poses=30, noise_a=0.002, stiction_nm=2.0, share=0.0, both=True, k2=None):
    """The same poses under each load; friction of the approach, growing with `share` of torque."""
    parts = []
    for number, load in enumerate(loads):
        data = dwelling(poses, load=load, noise_a=0.0, stiction_nm=stiction_nm, both=both, seed=2)
        if k2 is not None:
            data = data.with_columns(effort=bent_currents(data["effort"], k2))
        side = np.repeat([c.approach for c in data.conditions], 10)[:, None]
        whole = plant().with_payload(load) if load else plant()
        grows = side * share * np.abs(whole.gravity(data["q"])) / GAINS
        noise = noise_a * np.random.default_rng(number).normal(size=grows.shape)
        conditions = tuple(replace(c, load=number, id=f"{number}/{c.id}") for c in data.conditions)
        data = data.with_columns(effort=data["effort"] + grows + noise)
        # What a data sheet says: 5 % off.
        parts.append(replace(data, conditions=conditions, drive_gains=1.05 * GAINS))
    return Dataset.concatenate(parts)


def bent_currents(linear, k2):
    """Currents that make the same torque in a drive that bends, by bisection."""
    low, high = np.full_like(linear, -12.0), np.full_like(linear, 12.0)
    for _ in range(60):
        middle = (low + high) / 2
        short = torque_of(middle, k2) < linear * GAINS
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return low


def calibrated(*loads, **options) -> Gains:
    return calibrate_gains(sweep(*loads, **options), nominal())


@pytest.fixture(scope="module")
def gains() -> Gains:
    return calibrated(None, BESIDE)


def test_gains_are_found_within_their_errors(gains) -> None:
    deviation = (gains.gain[1:] - GAINS[1:]) / gains.gain_error[1:]
    assert np.max(np.abs(deviation)) < 3.5
    assert np.max(gains.gain_error[1:] / GAINS[1:]) < 0.005
    assert (gains.poses, gains.both_sides, gains.masses) == (30, True, (0.0, 3.0))


def test_vertical_axis_is_not_determined_and_says_why(gains) -> None:
    assert gains.determined.tolist() == [False, True, True, True, True, True]
    assert "vertical" in gains.reasons[0]
    assert np.isnan(gains.gain[0])


def test_a_load_on_the_flanges_axis_does_not_tell_the_last_joint() -> None:
    assert calibrated(None, ON_AXIS).determined.tolist() == [False, True, True, True, True, False]


def test_friction_that_grows_with_the_load_cancels_between_both_sides_only() -> None:
    both = calibrated(None, BESIDE, share=0.07)
    assert both.gain[1:] == pytest.approx(GAINS[1:], rel=0.005)
    below = sweep(None, BESIDE, share=0.07).select(lambda c: c.approach == 1)
    # From below, a raised arm holds part of its load by friction; which sign depends on the pose.
    one = calibrate_gains(below, nominal())
    assert not one.both_sides
    assert "friction that grows with the load is part of the gains" in one.notes[0]
    assert np.max(one.gain_error[1:4] / both.gain_error[1:4]) > 2


def test_bent_drives_show_k1_and_k2() -> None:
    found = calibrated(None, Payload(5.0, (0.05, 0.0, 0.05)), k2=K2, poses=60, noise_a=0.001)
    assert found.k1[1:3] == pytest.approx(GAINS[1:3], rel=0.01)
    assert np.all(np.abs(found.k2 - K2)[1:3] < 4 * found.k2_error[1:3])
    assert found.gain[1] < GAINS[1] - 0.5


def test_noise_in_the_current_does_not_make_gains_small() -> None:
    data = sweep(None, BESIDE, poses=400, noise_a=1.2)
    torque, rise = (
        np.diff(x.reshape(2, 400, 20, 6).mean(axis=2), axis=0)[0, :, 3]
        for x in (sweep(None, BESIDE, poses=400, noise_a=0.0)["effort"] * GAINS, data["effort"])
    )
    plain = (rise @ torque) / (rise @ rise)
    assert calibrate_gains(data, nominal()).gain[3] == pytest.approx(GAINS[3], rel=0.12)
    assert plain < 0.75 * GAINS[3]


def test_a_joint_with_too_little_torque_against_its_friction_is_not_determined() -> None:
    found = calibrated(None, Payload(0.05, (0.0, 0.0, 0.02)), noise_a=0.2)
    assert not found.determined.any()
    assert "too little against friction" in found.reasons[3]


@pytest.mark.parametrize("joint", [1, 5])
def test_a_negative_gain_is_not_determined_and_says_what_it_may_come_from(joint) -> None:
    data = sweep(None, BESIDE)
    effort = data["effort"].copy()
    effort[:, joint] *= -1.0
    found = calibrate_gains(data.with_columns(effort=effort), nominal())
    assert found.determined.tolist() == [j not in (0, joint) for j in range(6)]
    assert np.isnan(found.gain[joint])
    assert "counts in the other direction" in found.reasons[joint]
    assert found.to_dict()["yaml"][0].count("-") == 0


def test_recordings_of_each_load_with_their_own_numbers_are_paired_by_position() -> None:
    data = sweep(None, BESIDE)
    apart = tuple(
        replace(c, pose=99 - c.pose, source="other") if c.load else c for c in data.conditions
    )
    assert calibrate_gains(replace(data, conditions=apart), nominal()).gain[1:] == pytest.approx(
        calibrate_gains(data, nominal()).gain[1:]
    )


def test_an_arm_that_sags_under_the_load_has_the_same_gains() -> None:
    data = sweep(None, BESIDE, noise_a=0.0, stiction_nm=0.0)
    loaded = np.repeat([c.load for c in data.conditions], 10)[:, None]
    whole, q = plant().with_payload(BESIDE), data["q"]
    # 4 mrad at 15 N·m, as a controller without an integral part gives way.
    low = q - 0.004 / 15 * (whole.gravity(q) - plant().gravity(q))
    effort = data["effort"] + loaded * (whole.gravity(low) - whole.gravity(q)) / GAINS
    sagging = data.with_columns(q=np.where(loaded, low, q), effort=effort)
    assert 0.003 < np.max(np.abs(low - q)) < 0.01
    found = calibrate_gains(sagging, nominal())
    assert found.gain[1:] == pytest.approx(GAINS[1:], rel=1e-4)


def test_poses_without_a_partner_are_counted_in_a_note() -> None:
    data = sweep(None, BESIDE)
    assert calibrate_gains(data, nominal()).notes == ()
    # Pose 3 lacks one approach under load, poses 4 and 5 were never visited with it.
    partial = data.select(
        lambda c: not c.load or (c.pose not in (4, 5) and (c.pose, c.approach) != (3, -1))
    )
    found = calibrate_gains(partial, nominal())
    assert (found.poses, found.both_sides) == (27, True)
    assert "3 of 30 poses are left out: they were not approached from both sides" in found.notes[0]


def test_three_loads_are_all_used() -> None:
    found = calibrated(None, Payload(1.5, BESIDE.com), BESIDE)
    assert found.masses == (0.0, 1.5, 3.0)
    assert found.gain[1:] == pytest.approx(GAINS[1:], rel=0.01)


def test_yaml_lines_keep_what_was_declared_where_nothing_was_found(gains) -> None:
    import yaml

    document = yaml.safe_load("\n".join(gains.yaml_lines()))
    assert document["drive_gains_nm_a"][0] == pytest.approx(1.05 * GAINS[0], abs=1e-3)
    assert document["drive_gains_nm_a"][1:] == pytest.approx(gains.gain[1:], abs=1e-3)
    assert "shoulder_pan_joint as declared" in document["drive_gains_source"]
    nothing = calibrate_gains(replace(sweep(None, BESIDE), drive_gains=None), nominal())
    assert nothing.yaml_lines() == []


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (lambda: sweep(None), "at least two loads, the data have 0 kg only"),
        (lambda: sweep(None, BESIDE, poses=4), "4 poses .* are too few"),
        (lambda: replace(sweep(None, BESIDE), effort_kind="torque"), "the data hold a torque"),
        (lambda: moved(sweep(None, BESIDE)), "0 poses .* are too few"),
        (lambda: wild(sweep(None, BESIDE)), "1 .* of elbow_joint cannot be"),
    ],
)
def test_data_that_cannot_tell_are_refused(data, message) -> None:
    with pytest.raises(FitError, match=message):
        calibrate_gains(data(), nominal())


def wild(data):
    """One sample is garbage."""
    effort = data["effort"].copy()
    effort[7, 2] = 1e6
    return data.with_columns(effort=effort)


def moved(data):
    """The loaded program at other poses than the bare one."""
    loaded = np.repeat([c.load for c in data.conditions], 10)[:, None]
    return data.with_columns(q=data["q"] + 0.02 * loaded)


def test_no_source_is_no_recording() -> None:
    from hil.evaluation.drive_gains import gains_of_sources

    with pytest.raises(DataError, match="no recording"):
        gains_of_sources([])


def test_the_tests_currents_obey_eq_16() -> None:
    data = bent(5)
    assert torque_of(data["effort"], K2) / GAINS == pytest.approx(
        dwelling(5, noise_a=0.0)["effort"], abs=1e-9
    )
