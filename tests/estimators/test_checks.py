"""What fits refuse beyond the contract of test_conformance.py, and models of another robot."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from hil.core.errors import DataError, FitError
from hil.dynamics import RobotModel, load_model
from hil.dynamics.same_arm import may_be
from hil.estimators import load_model_file
from hil.estimators.checks import require_plausible
from hil.estimators.payload import estimate_payload
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from hil.evaluation import evaluate
from hil.evaluation.validation import under_load
from tests.support.load_parts import OFF_AXIS, recorded
from tests.support.synthetic_motion import GAINS, dwelling, nominal, raw


@pytest.mark.parametrize("form", ["shared", "paper"])
def test_a_target_that_is_zero_for_one_joint_is_fitted(form) -> None:
    """A torque-measuring arm in simulation: nothing pulls at a vertical axis."""
    data = dwelling(60)
    silent = data.with_columns(effort=data["effort"] * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    predicted = StaticWls(form=form).fit(silent, nominal()).predict(silent).effort
    assert predicted[:, 0] == pytest.approx(0.0, abs=1e-9)


def spoiled(data, value):
    effort = data["effort"].copy()
    effort[37, 3] = value
    return data.with_columns(effort=effort)


def test_without_gains_or_limits_only_what_nobody_builds_is_refused() -> None:
    data = replace(dwelling(60), drive_gains=None)
    with pytest.raises(FitError, match="are impossible"):
        StaticWls(form="paper").fit(spoiled(data, 1e6), nominal())
    unlimited = RobotModel.from_arm("ur5")
    unlimited.effort_max = np.zeros(6)
    require_plausible(spoiled(data, 1e3), unlimited)
    with pytest.raises(FitError, match="are impossible"):
        require_plausible(spoiled(data, 1.1e6), unlimited)


def test_a_joint_at_its_limit_and_efforts_in_another_unit_are_no_outliers() -> None:
    data = dwelling(60)
    require_plausible(spoiled(data, 3 * nominal().effort_max[3] / GAINS[3]), nominal())
    require_plausible(data.with_columns(effort=1e3 * data["effort"]), nominal())


# Models of another robot, by name and by the arms' axes

ARM = """<robot name="arm">
<link name="base"/><link name="upper">{body}</link><link name="lower">{body}</link>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="100"/></joint>
<joint name="b" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="{reach} 0 0.2" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="100"/></joint></robot>"""
BODY = """<inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>"""


def urdf(folder: Path, name: str, reach: float = 0.4, roll: float = 0.0) -> str:
    path = folder / f"{name}.urdf"
    path.write_text(ARM.format(reach=reach, roll=roll, body=BODY), "utf-8")
    return str(path)


def test_built_in_arms_are_told_by_name_and_the_nameless_pass() -> None:
    ur5 = load_model("ur5")
    for name in ("ur5", "", "the arm in the corner", "gone/arm.urdf"):
        assert may_be(name, ur5)
    for name in ("ur10e", "ur5e"):
        assert not may_be(name, ur5)


def test_urdfs_are_told_by_how_their_axes_lie(tmp_path: Path) -> None:
    own = load_model(urdf(tmp_path, "own"))
    assert may_be(urdf(tmp_path, "calibrated", reach=0.403, roll=0.01), own)
    assert not may_be(urdf(tmp_path, "longer", reach=0.5), own)
    assert not may_be(urdf(tmp_path, "inclined", roll=0.3), own)
    assert not may_be("ur5", own)


def test_descriptions_of_an_arm_are_told_by_how_their_axes_lie(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(Path(str(files("hil.arms") / "ur5.yaml")).read_text("utf-8"), "utf-8")
    described = load_model(str(own))
    assert may_be("ur5", described)
    assert may_be(str(own), load_model("ur5"))
    for name in ("ur10e", "ur5e"):
        assert not may_be(name, described)


def test_a_description_is_found_on_the_side_of_its_motors(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(Path(str(files("hil.arms") / "tx40.yaml")).read_text("utf-8"), "utf-8")
    coupled = load_model(f"{own}@motors").joints_per_motor
    assert coupled == pytest.approx(load_model("tx40@motors").joints_per_motor)


def test_a_model_of_a_ur10e_is_not_judged_on_a_ur5(tmp_path: Path) -> None:
    ur5 = recorded(1, 1, 2)
    other = RigidWls().fit(replace(ur5, robot="ur10e"), load_model("ur10e"))
    loaded = raw(recorded(1, 5, load=OFF_AXIS[1]))
    stored = load_model_file(other.save(tmp_path / "model"))
    for judge in (
        lambda model: model.predict(ur5),
        lambda model: evaluate(model, loaded),
        lambda model: estimate_payload(model, loaded),
        lambda model: under_load(model, loaded, None),
    ):
        with pytest.raises(DataError, match="the model is for a ur10e, the data are from a ur5"):
            judge(stored)
    assert len(stored.predict(replace(ur5, robot="")).effort)
