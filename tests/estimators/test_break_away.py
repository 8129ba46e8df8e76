"""What a joint holds by friction at rest, as friction with a memory knows it."""

from __future__ import annotations

import numpy as np
import pytest

from hil.control.rest_pose import COUNTED, rest_poses
from hil.estimators.friction_library import FrictionLaw, Shapes
from hil.estimators.standstill import holding_friction
from hil_mock_robot.plant.friction import COLD_C, STRIBECK_GONE_C
from hil_mock_robot.plant.truth import draw_truth
from tests.support.collision_parts import fitted

SHAPES = Shapes(np.array([1e-3]), np.array([0.05]), np.array([0.5]), np.array([np.nan]))


def law(**groups):
    names, values = tuple(groups), [np.atleast_1d(v) for v in groups.values()]
    return FrictionLaw((names,), (np.concatenate(values).astype(float),), SHAPES)


CORE = {"core": [0.7, 5.0, 3.0]}
"""Offset, viscous and Coulomb friction."""


def test_offset_and_viscous_friction_hold_nothing():
    assert law(**CORE).break_away() == pytest.approx([3.0])


def test_the_whole_stribeck_peak_and_every_memory_hold():
    more = {"stribeck": 0.8, "memory 3": 0.4, "memory 30": -0.1, "speed p": 2.0}
    assert law(**CORE, **more).break_away() == pytest.approx([3.0 + 0.8 + 0.4 - 0.1])


def test_friction_that_grows_with_the_load_is_not_counted():
    assert law(**CORE, load=0.1, braking=0.2).break_away() == pytest.approx([3.0])


def test_friction_that_changes_with_the_angle_counts_where_it_is_least():
    assert law(**CORE, **{"turn 1 dry": [0.3, 0.4]}).break_away() == pytest.approx([2.5], abs=1e-3)


def test_no_joint_holds_less_than_nothing():
    assert law(core=[0.0, 1.0, -0.2]).break_away() == pytest.approx([0.0])


def true_break_away(truth):
    """(n,) torque at which an unloaded joint of the mock begins to slide [N·m]."""
    celsius = truth.ambient_c
    cold = np.clip((STRIBECK_GONE_C - celsius) / (STRIBECK_GONE_C - COLD_C), 0.0, 1.0)
    return np.array(
        [
            joint.friction.coulomb_nm
            * (1.0 + joint.thermal.coulomb_per_k * (celsius - truth.reference_c))
            + cold * joint.friction.stribeck_nm
            for joint in truth.joints
        ]
    )


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [2, 5])
def test_the_break_away_of_a_fitted_model_is_that_of_the_mock(seed):
    truth = draw_truth("ur5", seed)
    share = holding_friction(fitted(seed)) / true_break_away(truth)
    assert np.all(share > 0.7)
    assert np.all(share < 1.3)
    # At rest the mock's contacts creep, down to a share of what they hold at first: what is
    # relied upon stays below that.
    lasting = [joint.friction.creep_floor for joint in truth.joints]
    assert np.all(COUNTED * share < lasting)


@pytest.mark.thorough
def test_rest_poses_of_a_model_with_memory_know_what_its_joints_hold(tmp_path, monkeypatch):
    monkeypatch.setattr("hil.control.rest_pose.STARTS", 4)
    monkeypatch.delenv("HIL_STATION", raising=False)
    model = fitted(5)
    report = rest_poses(model.save(tmp_path / "model"), count=1)
    assert report.friction == pytest.approx(model.break_away())
    assert not any("no dry friction" in note for note in report.notes)
    assert np.isfinite(report.poses[0].fail.spare).all()
