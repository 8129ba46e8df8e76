"""An exported URDF, read by plain Pinocchio, has the gravity and inertia of the model."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import hil
from hil.core.errors import FitError
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from hil.export.urdf import UrdfExport, export_urdf
from tests.support.paths import EXPERIMENTS
from tests.support.synthetic_motion import fourier, moving, nominal

SPEC = EXPERIMENTS / "ci_fourier_2.yaml"
EXACT = 1e-9
"""Share of a joint's largest torque: rounding."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Three short trajectories of the mock UR5."""
    os.environ.pop("HIL_STATION", None)
    report = hil.run(hil.load(SPEC), runs=tmp_path_factory.mktemp("runs"))
    return hil.dataset(report.run)


def torques_of(urdf: Path, *motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gravity and inertia (N, n) by Pinocchio; rotor inertias are taken from the file."""
    model = pin.buildModelFromUrdf(str(urdf))
    armature = np.zeros(model.nv)
    for joint in ET.parse(urdf).getroot().iter("joint"):
        if joint.get("type") == "revolute":
            index = model.joints[model.getJointId(joint.get("name"))].idx_v
            armature[index] = float(joint.find("dynamics").get("armature"))
    model.armature = armature
    data = model.createData()
    gravity = np.array([pin.computeGeneralizedGravity(model, data, q) for q in motion[0]])
    whole = np.array([pin.rnea(model, data, *row) for row in zip(*motion, strict=True)])
    return gravity, whole - gravity


def differences(model: RobotEstimator, told: UrdfExport) -> np.ndarray:
    """(2, n) RMS of gravity and inertia, Pinocchio's less the model's own [N·m]."""
    parts = model.predict(moving(21)).components
    found = torques_of(told.out, *fourier(21)[1:])
    wanted = [parts[name] * model.torque_scale_ for name in ("gravity", "inertia")]
    assert np.all(np.abs(wanted[1]).max(axis=0) > 0.05)
    return np.sqrt(np.mean((np.array(found) - wanted) ** 2, axis=1))


def largest(model: RobotEstimator) -> float:
    parts = model.predict(moving(21)).components
    return float(np.max(np.abs((parts["gravity"] + parts["inertia"]) * model.torque_scale_)))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["rigid-lmi", "rigid-hysteresis"])
def test_links_of_a_model_of_the_mock_have_its_torques(name: str, recorded, tmp_path) -> None:
    pytest.importorskip("cvxpy")
    model = estimator(name).fit(recorded, nominal())
    told = export_urdf(model, tmp_path / "arm.urdf")
    assert np.max(differences(model, told)) < EXACT * largest(model)


@pytest.mark.thorough
def test_base_parameters_of_links_that_exist_have_their_torques(tmp_path) -> None:
    pytest.importorskip("cvxpy")
    model = estimator("rigid-wls").fit(moving(1, 2, 3), nominal())
    told = export_urdf(model, tmp_path / "arm.urdf")
    assert np.max(differences(model, told)) < EXACT * largest(model)


@pytest.mark.thorough
def test_base_parameters_of_the_mock_miss_them_by_no_more_than_is_told(recorded, tmp_path) -> None:
    """Fifteen seconds with noise: no links that exist have just these base parameters."""
    pytest.importorskip("cvxpy")
    model = estimator("rigid-wls").fit(recorded, nominal())
    with pytest.raises(FitError, match=r"no links .* come near .*wrist_2_joint \d+%") as refused:
        export_urdf(model, tmp_path / "arm.urdf")
    assert "--unchecked" in str(refused.value.hint)
    told = export_urdf(model, tmp_path / "arm.urdf", unchecked=True)
    assert "gravity and inertia missed by " in told.checked
    assert told.miss.rigid.max() > 0.05
    (note,) = told.found.notes
    assert note.startswith("no links within bounds have the model's base parameters; these come")
    assert np.max(told.found.mismatch) < 0.005 * largest(model)
    whole = np.sqrt(np.sum(differences(model, told) ** 2, axis=0))
    assert np.all(whole < 3.0 * told.found.mismatch)
