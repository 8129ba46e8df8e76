"""Loads from poses that an arm holds: friction from both sides, and what does not show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError
from hil.data import Dataset
from hil.estimators.payload import true_values
from hil.estimators.payload_at_rest import estimate_payload_at_rest
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from tests.support.synthetic_motion import GAINS, LOAD, dwelling, moving, nominal, plant

FRICTION_NM = 4.0
ON_AXIS = replace(LOAD, com=(0.0, 0.0, 0.06))


@cache
def arm(kind=StaticWls):
    if kind is RigidWls:
        return RigidWls().fit(moving(1, 2, 3), nominal())
    return kind().fit(dwelling(60, seed=1, both=True), nominal())


def held(poses=6, *, load: Payload | None = LOAD, both=True, **options) -> Dataset:
    """Dwells with a load that nobody declared."""
    data = dwelling(poses, seed=7, stiction_nm=FRICTION_NM, both=both, load=load, **options)
    return undeclared(data)


def undeclared(data: Dataset) -> Dataset:
    return replace(data, conditions=tuple(replace(c, payload=Payload()) for c in data.conditions))


def at(q, load: Payload = LOAD) -> Dataset:
    """Dwells at these poses (P, 6), from both sides."""
    data = held(len(q), load=load)
    pose = np.repeat(q, 20, axis=0)
    side = np.tile(np.repeat([1.0, -1.0], 10), len(q))[:, None]
    torque = plant().with_payload(load).gravity(pose) + FRICTION_NM * side
    return data.with_columns(q=pose, effort=torque / GAINS)


@pytest.mark.parametrize("kind", [StaticWls, RigidWls])
def test_mass_and_centre_show_at_rest_and_inertia_does_not(kind) -> None:
    found = estimate_payload_at_rest(arm(kind), held())
    assert found.values[:4] == pytest.approx(true_values(LOAD)[:4], rel=0.05, abs=3e-3)
    assert found.payload.mass == found.values[0]
    assert np.isnan(found.values[4:]).all()
    assert not any(found.determined[name] for name in ("Ixx", "Iyz"))
    assert "does not show a load's inertia" in found.notes[0]


def test_what_does_not_show_is_null_in_json() -> None:
    told = estimate_payload_at_rest(arm(), held()).to_dict()
    assert told["payload"]["inertia_kgm2"] == [None] * 6
    assert told["parameters"][9]["interval_95"] == [None, None]
    assert told["payload"]["com_m"] == pytest.approx(LOAD.com, abs=5e-3)


def test_the_bare_arm_weighed_too_takes_the_model_s_errors_away() -> None:
    shift = np.array([0.1, -0.3, 0.2, 0.05, 0.04, -0.03])
    loaded, bare = held(), held(load=None)
    moved = [data.with_columns(effort=data["effort"] + shift) for data in (loaded, bare)]
    plain = estimate_payload_at_rest(arm(), moved[0])
    tared = estimate_payload_at_rest(arm(), moved[0], bare=moved[1])
    truth = true_values(LOAD)[:4]
    assert tared.values[:4] == pytest.approx(truth, rel=2e-3, abs=1e-3)
    assert np.abs(plain.values[1:4] - truth[1:]).max() > 4e-3
    assert np.all(tared.std_error[:4] < 0.7 * plain.std_error[:4])


def test_the_bare_arm_must_have_held_the_same_poses() -> None:
    elsewhere = undeclared(dwelling(6, seed=8, both=True))
    with pytest.raises(DataError, match="6 of 6 poses were not held with the bare flange"):
        estimate_payload_at_rest(arm(), held(), bare=elsewhere)
    one_sided = held(load=None, both=False)
    with pytest.raises(DataError, match="not approached from the same sides"):
        estimate_payload_at_rest(arm(), held(), bare=one_sided)


def test_errors_grow_with_those_of_the_gains() -> None:
    sure, unsure = (
        estimate_payload_at_rest(arm(), held(), bare=held(load=None), gain_share=share)
        for share in (0.0, 0.1)
    )
    assert unsure.std_error[0] > LOAD.mass * 0.03 > 1.2 * sure.std_error[0]


def test_nothing_mounted_has_no_centre() -> None:
    found = estimate_payload_at_rest(arm(), held(load=None))
    assert found.payload.is_empty
    assert found.interval[0, 0] < 0.0 < found.interval[0, 1]
    assert np.isnan(found.values[1:]).all()
    assert found.to_dict()["payload"]["com_m"] == [None] * 3


def test_a_vertical_flange_does_not_show_how_far_out_the_centre_is() -> None:
    lift, elbow = np.radians([[-60, -90, -110, -70], [60, 90, 110, 20]])
    q = np.zeros((4, 6))
    q[:, 0], q[:, 1], q[:, 2], q[:, 5] = [0.1, 0.5, 1.0, -0.4], lift, elbow, [0.0, 1.0, 2.0, -2.0]
    q[:, 3], q[:, 4] = np.radians(-90) - lift - elbow, np.radians(-90)
    found = estimate_payload_at_rest(arm(), at(q))
    assert np.isfinite(found.values[:3]).all()
    assert np.isnan(found.values[3])
    assert any("do not show com_z" in note for note in found.notes)


def test_poses_that_the_load_does_not_load_do_not_show_its_mass() -> None:
    upright = np.tile(np.radians([0.0, -90, 0, -90, 0, 0]), (2, 1))
    upright[1, 0] = 1.0
    with pytest.raises(FitError, match="do not show the mass"):
        estimate_payload_at_rest(arm(), at(upright))


def test_a_centre_on_the_axis_does_not_show_the_angle_of_the_mount() -> None:
    on, off = (
        estimate_payload_at_rest(arm(), held(load=load), bare=held(load=None))
        for load in (ON_AXIS, LOAD)
    )
    assert any("which way round" in note for note in on.notes)
    assert not any("which way round" in note for note in off.notes)


def test_from_one_side_friction_is_part_of_the_errors() -> None:
    both = estimate_payload_at_rest(arm(RigidWls), held())
    one = estimate_payload_at_rest(arm(RigidWls), held(both=False))
    assert 3 * both.std_error[0] < one.std_error[0] < 6 * both.std_error[0]
    assert one.interval[0, 0] <= LOAD.mass <= one.interval[0, 1]
    assert any("6 of 6 poses were approached from one side only" in note for note in one.notes)
    with pytest.raises(FitError, match="approached from both sides"):
        estimate_payload_at_rest(arm(), held(both=False))


def test_an_arm_lighter_than_its_model_is_no_load() -> None:
    loaded = undeclared(dwelling(60, seed=1, both=True, load=LOAD))
    heavy = StaticWls().fit(loaded, nominal())
    with pytest.raises(FitError, match="lighter at the flange than the model has it"):
        estimate_payload_at_rest(heavy, held(load=None))


def test_motion_without_a_rest_says_so() -> None:
    with pytest.raises(FitError, match="never rested"):
        estimate_payload_at_rest(arm(), moving(1))


def test_a_model_without_gains_does_not_weigh() -> None:
    data = replace(dwelling(60, seed=1, both=True), drive_gains=None)
    blind = StaticWls(form="paper").fit(data, nominal())
    with pytest.raises(FitError, match="nobody knows how much torque"):
        estimate_payload_at_rest(blind, held(load=None))


def test_a_model_that_hardly_knows_its_arm_is_unsure() -> None:
    vague = StaticWls().fit(dwelling(60, seed=1, both=True), nominal())
    vague.sigma_ = 3.0 * FRICTION_NM / GAINS
    found = estimate_payload_at_rest(vague, held())
    assert found.std_error[0] > 1.5 * estimate_payload_at_rest(arm(), held()).std_error[0]
    tared = estimate_payload_at_rest(vague, held(), bare=held(load=None))
    assert tared.std_error[0] < 0.3 * found.std_error[0]
