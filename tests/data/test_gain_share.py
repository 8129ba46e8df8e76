"""How well drive gains are taken to be known, by where they come from."""

from __future__ import annotations

import numpy as np
import pytest

from hil.estimators.base import RobotEstimator, estimator
from hil.estimators.drive_gains import calibrated, gain_lines
from hil.estimators.rigid_linear import RigidWls
from hil.evaluation.payload import usual_gain_share
from tests.support.synthetic_motion import arriving, moving, nominal


def fitted(source: str, kind: str = "current") -> RobotEstimator:
    model = RigidWls().fit(moving(1, 2, kind=kind), nominal())
    model.gains_source_ = source
    return model


@pytest.mark.parametrize(
    ("source", "share"),
    [
        ("", 0.05),
        ("data sheet", 0.05),
        ("calibrated with 0, 3 kg at 40 poses", 0.01),
        ("calibrated with 0, 3 kg at 40 poses; shoulder_pan_joint as declared before", 0.05),
        ("the controller's current per torque over 900 samples", 0.01),
    ],
)
def test_gains_of_this_very_arm_are_known_better(source: str, share: float) -> None:
    assert usual_gain_share(fitted(source)) == share


def test_torques_have_no_gains() -> None:
    assert usual_gain_share(fitted("", "torque")) == 0.0


def test_what_hil_gains_writes_is_recognised() -> None:
    names, gain = ("a", "b"), np.array([10.0, 11.0])
    source = "calibrated with 0, 3 kg at 40 poses"
    for reasons, known in ((("", ""), True), (("", "hardly moved"), False)):
        line = gain_lines(names, gain, reasons, gain, source)[1]
        assert calibrated(line.split('"')[1]) is known


@pytest.mark.filterwarnings("error")
def test_a_stream_takes_poses_that_jump() -> None:
    stream = estimator("static-hysteresis").fit(arriving(60, seed=1), nominal()).stream()
    still = np.zeros(6)
    told = [stream.step(np.full(6, 0.3 * k), still, still) for k in range(4) for _ in range(20)]
    assert np.isfinite(told).all()
