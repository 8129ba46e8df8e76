"""Models of another robot than the data's, by name and by the arms' axes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError
from hil.dynamics import load_model
from hil.dynamics.robot_model import may_be
from hil.estimators.base import load_model_file
from hil.estimators.payload import estimate_payload
from hil.estimators.rigid_linear import RigidWls
from hil.evaluation import evaluate
from hil.evaluation.validation import under_load
from tests.support.load_parts import OFF_AXIS, recorded
from tests.support.synthetic_motion import moving, nominal, raw

ARM = """<robot name="arm">
<link name="base"/><link name="upper"/><link name="lower"/>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="100"/></joint>
<joint name="b" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="{reach} 0 0.2" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="100"/></joint></robot>"""
BODY = """<inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>"""


def urdf(folder: Path, name: str, reach: float = 0.4, roll: float = 0.0) -> str:
    text = ARM.format(reach=reach, roll=roll)
    for link in ("upper", "lower"):
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{BODY}</link>')
    path = folder / f"{name}.urdf"
    path.write_text(text, "utf-8")
    return str(path)


def test_built_in_arms_are_told_by_name_and_the_nameless_pass() -> None:
    ur5 = load_model("ur5")
    assert may_be("ur5", ur5)
    assert may_be("", ur5)
    assert may_be("the arm in the corner", ur5)
    assert may_be("gone/arm.urdf", ur5)
    assert not may_be("ur10e", ur5)
    assert not may_be("ur5e", ur5)


def test_urdfs_are_told_by_how_their_axes_lie(tmp_path: Path) -> None:
    own = load_model(urdf(tmp_path, "own"))
    assert may_be(urdf(tmp_path, "calibrated", reach=0.403, roll=0.01), own)
    assert not may_be(urdf(tmp_path, "longer", reach=0.5), own)
    assert not may_be(urdf(tmp_path, "inclined", roll=0.3), own)
    assert not may_be("ur5", own)


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
        with pytest.raises(DataError, match="the model is of a ur10e, the data are of a ur5"):
            judge(stored)
    assert len(stored.predict(replace(ur5, robot="")).effort)


def test_a_model_knows_the_loads_it_was_fitted_with(tmp_path: Path) -> None:
    loads = Payload(2.0, (0.02, -0.03, 0.06), (0.004, 0.005, 0.003, 0.0, 0.0, 0.0))
    model = RigidWls().fit(moving(1, 2, load=loads), nominal())
    stored = load_model_file(model.save(tmp_path / "model"))
    assert stored.training_ is not None
    assert stored.training_.payloads == (loads,)
