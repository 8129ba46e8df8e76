"""Identified models as URDFs: other programs' torques, bytes that stay, links that exist."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import FitError
from hil.dynamics import RobotModel
from hil.dynamics.inertial import about_centre, body_parameters, is_consistent
from hil.estimators.rigid_linear import RigidWls
from hil.export import identified_parameters
from hil.export import urdf as urdf_module
from hil.export.urdf import UrdfExport, edited, export_urdf, roll_pitch_yaw
from tests.support.dynamics_arms import motion, mujoco_torques, urdf, written
from tests.support.export_models import exact, fitted, torques_of
from tests.support.export_readers import parts_of, urdf_torques
from tests.support.synthetic_motion import COULOMB, ROTORS, VISCOUS, fourier, moving, nominal, plant

WALL = (9.81, 0.0, 0.0)
COVERED = """<?xml version="1.0"?>
<robot name="two &amp; more"><!-- kept -->
  <link name="base"/>
  <link   name='arm'>
    <visual><geometry><mesh filename="arm.stl"/></geometry></visual>
  </link>
  <link name="cover"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0"
     iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="hand"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="9" velocity="3"/></joint>
  <joint name="fix" type="fixed"><parent link="arm"/><child link="cover"/></joint>
  <joint name="b" type="revolute"><parent link="arm"/><child link="hand"/>
    <dynamics damping="9"/><limit lower="-1" upper="1" effort="9" velocity="3"/></joint>
</robot>
"""


@pytest.fixture(scope="module")
def model() -> RigidWls:
    """Fitted to noise-free data: the true base parameters, which belong to bodies that exist."""
    return exact()


@pytest.fixture(scope="module")
def exported(model, tmp_path_factory) -> UrdfExport:
    return export_urdf(model, tmp_path_factory.mktemp("urdf") / "robot.urdf")


def test_the_file_read_back_has_the_torques_that_were_written(exported) -> None:
    motions = motion(40)
    expected = (nominal().regressor(*motions) @ exported.found.inertial).reshape(40, 6)
    assert RobotModel.from_urdf(exported.out).inverse_dynamics(*motions) == pytest.approx(
        expected, abs=1e-9
    )
    assert exported.miss.rigid.max() < 1e-9
    assert exported.miss.friction.max() < 1e-9


def test_links_exist_and_have_the_base_parameters_found(exported) -> None:
    assert np.all(is_consistent(exported.found.inertial[:60].reshape(6, 10)))
    assert np.all(exported.found.inertial[60:] >= 0)
    assert exported.found.mismatch == pytest.approx(np.zeros(6), abs=1e-6)
    assert exported.found.inertial[62:] == pytest.approx(ROTORS[2:], abs=0.02)


def test_friction_and_limits_are_in_the_file(exported) -> None:
    text = exported.out.read_text("utf-8")
    told = re.findall(r'damping="([^"]+)" friction="([^"]+)"', text)
    viscous, coulomb = np.array(told, dtype=float).T
    assert coulomb == pytest.approx(COULOMB, rel=1e-6)
    assert viscous == pytest.approx(VISCOUS, rel=1e-6)
    again = RobotModel.from_urdf(exported.out)
    assert again.q_max == pytest.approx(nominal().q_max)
    assert again.effort_max == pytest.approx(nominal().effort_max)


def test_loads_hang_where_they_did(exported) -> None:
    q = motion(10)[0]
    again = RobotModel.from_urdf(exported.out)
    assert again.flange_pose(q) == pytest.approx(nominal().flange_pose(q), abs=1e-12)


@pytest.mark.thorough
def test_mujoco_finds_the_torques_of_the_true_arm_in_the_file(exported) -> None:
    mujoco = pytest.importorskip("mujoco")
    peer = mujoco.MjModel.from_xml_path(str(exported.out))
    peer.dof_armature[:] = RobotModel.from_urdf(exported.out).rotor_inertia
    peer.dof_damping[:], peer.dof_frictionloss[:] = 0.0, 0.0
    peer.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    motions = motion(40)
    expected = plant().inverse_dynamics(*motions)
    assert mujoco_torques(peer, *motions) == pytest.approx(expected, abs=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["rigid-hysteresis", "exact"])
def test_plain_pinocchio_finds_the_torques_of_the_model(kind, tmp_path) -> None:
    model = exact() if kind == "exact" else fitted(kind)
    told = export_urdf(model, tmp_path / "arm.urdf")
    q, qd, qdd = motions = fourier(21, 200)[1:]
    parts = parts_of(model, motions)
    gravity = urdf_torques(told.out, (q, 0.0 * qd, 0.0 * qdd))
    whole = parts["gravity"] + parts["inertia"] + parts.get("coriolis", 0.0)
    share = 1e-9 * np.abs(whole).max()
    assert gravity == pytest.approx(parts["gravity"], rel=0.0, abs=share)
    assert urdf_torques(told.out, motions) == pytest.approx(whole, rel=0.0, abs=share)
    assert np.all(np.abs(parts["inertia"]).max(axis=0) > 0.05)


@pytest.mark.thorough
def test_links_nearest_to_noise_miss_it_by_no_more_than_is_told(tmp_path: Path) -> None:
    """No links that exist have just these base parameters."""
    noisy = RigidWls().fit(moving(1, noise_a=0.3), nominal())
    with pytest.raises(
        FitError, match=r"no physically consistent links .*wrist_2_joint \d+%"
    ) as refused:
        export_urdf(noisy, tmp_path / "arm.urdf")
    assert "--no-check" in str(refused.value.hint)
    told = export_urdf(noisy, tmp_path / "arm.urdf", unchecked=True)
    assert "gravity and inertia: error " in told.checked
    assert told.miss.rigid.max() > 0.05
    (note,) = told.found.notes
    assert note.startswith(
        "no physically consistent links within the bounds have the model's base "
    )
    assert np.all(is_consistent(told.found.inertial[:60].reshape(6, 10)))
    motions = fourier(21)[1:]
    parts = parts_of(noisy, motions)
    missed = urdf_torques(told.out, motions) - (parts["gravity"] + parts["inertia"])
    assert np.max(told.found.mismatch) > 1e-3
    assert np.all(np.sqrt(np.mean(missed**2, axis=0)) < 3.0 * told.found.mismatch)


@pytest.mark.thorough
def test_parameters_of_bodies_are_written_as_they_are(tmp_path: Path) -> None:
    other = RigidWls().fit(moving(1), nominal())
    other.inertial_ = plant().parameters()
    found = export_urdf(other, tmp_path / "own.urdf", unchecked=True)
    assert found.found.own
    again = RobotModel.from_urdf(found.out).parameters()
    assert again == pytest.approx(plant().parameters(), abs=1e-12)


@pytest.mark.thorough
def test_the_model_under_a_network_gives_its_own_links(exported, tmp_path: Path) -> None:
    network = RigidWls().fit(moving(1, 2, 3), nominal())
    network.base_ = RigidWls().fit(moving(1, 2, 3), nominal())
    network.base_.inertial_ = exported.found.inertial
    told = export_urdf(network, tmp_path / "b.urdf")
    assert told.found.own
    assert told.miss.rigid.max() < 1e-9


@pytest.mark.thorough
def test_a_model_that_is_no_rigid_body_is_refused_unless_wanted(tmp_path: Path) -> None:
    class Odd(RigidWls):
        def predict(self, dataset):
            told = super().predict(dataset)
            parts = dict(told.components)
            parts["inertia"] = parts["inertia"] + 0.3 * np.abs(parts["gravity"])
            return replace(told, components=parts)

    odd = Odd().fit(moving(1, 2, 3), nominal())
    with pytest.raises(FitError, match=r"largest torque: .*shoulder_lift_joint \d+%"):
        export_urdf(odd, tmp_path / "a.urdf")
    told = export_urdf(odd, tmp_path / "a.urdf", unchecked=True)
    assert told.checked.startswith(
        "read back and compared with the model: gravity and inertia: error "
    )
    assert told.miss.rigid.max() > 0.05
    assert not told.found.exact


def swapped(honest: Callable[..., str]) -> Callable[..., str]:
    return lambda found, j: honest(replace(found, coulomb=found.viscous, viscous=found.coulomb), j)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("module", "name", "bent"),
    [
        (urdf_module, "dynamics", swapped),
        (identified_parameters, "plain_friction", lambda honest: lambda model: honest(model)[::-1]),
    ],
    ids=["written", "asked for"],
)
def test_friction_that_is_not_the_nearest_is_found_out(
    module, name, bent, model, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(module, name, bent(getattr(module, name)))
    with pytest.raises(FitError, match="are not the best approximation of the model's: difference"):
        export_urdf(model, tmp_path / "a.urdf")
    assert list(tmp_path.iterdir()) == []


# The robot's own file.


@pytest.mark.thorough
def test_a_robots_own_urdf_is_edited(tmp_path: Path) -> None:
    path = written(tmp_path, urdf("ur5"))
    own = RobotModel.from_urdf(path)
    found = export_urdf(RigidWls().fit(moving(1, 2, 3), own), tmp_path / "identified.urdf")
    assert found.edited
    text, before = found.out.read_text("utf-8"), path.read_text("utf-8")
    stripped = re.sub(r"<inertial>.*?</inertial>|\s*<dynamics [^>]*/>\s*", "", text)
    assert stripped == re.sub(r"<inertial>.*?</inertial>", "", before)
    motions = motion(20)
    expected = plant().inverse_dynamics(*motions)
    assert RobotModel.from_urdf(found.out).inverse_dynamics(*motions) == pytest.approx(
        expected, abs=1e-4
    )


def test_only_what_changes_is_touched() -> None:
    dynamics = {"a": '<dynamics damping="1"/>', "b": '<dynamics damping="2"/>'}
    inertials = {"a": "<inertial>A</inertial>", "b": "<inertial>B</inertial>"}
    out = edited(COVERED.encode(), inertials, dynamics).decode()
    expected = COVERED.replace(
        '  </link>\n  <link name="cover">',
        '    <inertial>A</inertial>\n  </link>\n  <link name="cover">',
    )
    cover = re.search(r'<link name="cover">(.*?)</link>', COVERED, re.DOTALL)
    assert cover
    expected = expected.replace(cover[1], '<!-- inertial: part of link "arm" -->')
    expected = expected.replace(
        '<link name="hand"/>', '<link name="hand">\n    <inertial>B</inertial>\n  </link>'
    )
    expected = expected.replace(
        'velocity="3"/></joint>', 'velocity="3"/>  <dynamics damping="1"/>\n  </joint>', 1
    )
    expected = expected.replace('<dynamics damping="9"/>', '<dynamics damping="2"/>')
    assert out == expected


def test_rotor_inertias_of_a_urdf_are_read_unless_others_are_given(tmp_path: Path) -> None:
    text = urdf("ur5").replace("</joint>", '<dynamics damping="0" armature="0.3"/></joint>', 1)
    path = written(tmp_path, text)
    assert RobotModel.from_urdf(path).rotor_inertia == pytest.approx([0.3, 0, 0, 0, 0, 0])
    assert RobotModel.from_urdf(path, [0.1] * 6).rotor_inertia == pytest.approx([0.1] * 6)


@pytest.mark.thorough
@pytest.mark.parametrize("own", [False, True], ids=["built in", "its own URDF"])
def test_walls_and_ceilings_are_said_so(own: bool, exported, tmp_path: Path) -> None:
    robot = RobotModel.from_arm("ur5", gravity=WALL)
    if own:
        robot = RobotModel.from_urdf(exported.out, gravity=WALL)
    told = export_urdf(RigidWls().fit(torques_of(robot), robot), tmp_path / "wall.urdf")
    said = "URDF does not contain gravity: set (9.81, 0, 0) m/s2 in the base frame after loading"
    assert said in told.notes
    assert said in told.out.read_text("utf-8")
    assert not [note for note in exported.notes if "gravity" in note]
    read = pin.buildModelFromUrdf(str(told.out))
    read.gravity.linear = np.array(WALL)
    q = np.full(6, 0.3)
    found = pin.computeGeneralizedGravity(read, read.createData(), q)
    assert found == pytest.approx(robot.gravity(q[None])[0], abs=1e-6)


@pytest.mark.parametrize("angles", [(0.3, -0.2, 2.9), (1.0, np.pi / 2, 0.5), (2.0, -np.pi / 2, 0)])
def test_angles_give_the_rotation_back(angles) -> None:
    R = Rotation.from_euler("xyz", angles).as_matrix()
    again = Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix()
    assert again == pytest.approx(R, abs=1e-12)


def test_a_body_about_its_centre_is_the_body_about_the_origin() -> None:
    inertia = np.array([[0.03, 0.001, -0.002], [0.001, 0.04, 0.003], [-0.002, 0.003, 0.05]])
    mass, com, about = about_centre(body_parameters(2.0, (0.1, -0.2, 0.3), inertia))
    assert mass == 2.0
    assert com == pytest.approx([0.1, -0.2, 0.3], abs=1e-15)
    assert about == pytest.approx(inertia, abs=1e-15)


# The command.


def printed(*arguments: Any) -> str:
    return CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False).stdout


@pytest.mark.parametrize("as_json", [True, False])
def test_the_command_tells_what_is_in_the_file(
    exported, model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, as_json: bool
) -> None:
    monkeypatch.setattr("hil.export.urdf.export_urdf", lambda *_, **__: exported)
    folder, more = model.save(tmp_path / "model"), ["--json"] * as_json
    text = printed("export", folder, "--to", "urdf", "-o", tmp_path / "r.urdf", *more)
    if as_json:
        told = json.loads(text)
        assert told["rotor_inertia_kgm2"][2:] == pytest.approx(ROTORS[2:].tolist(), abs=0.02)
        assert told["checked"] == exported.checked
        assert told["files"] == ["robot.urdf"]
    else:
        assert "wrist_3_joint" in text
        assert f"{exported.out}: rigid-wls, written from the built-in arm" in text
        assert text.splitlines()[-1].startswith("  read back and compared with the model: gravity")


@pytest.mark.thorough
def test_the_command_has_the_units_of_joints_that_slide(tmp_path: Path) -> None:
    folder = fitted("rigid-wls on sliding").save(tmp_path / "model")
    text = printed("export", folder, "--to", "urdf", "-o", tmp_path / "b.urdf")
    (row,) = [line for line in text.splitlines() if line.startswith("r ")]
    assert "3.000 N " in row
    assert "2.000 N·s/m" in row
    assert not [line for line in text.splitlines() if line[:2] == "x " and "N·s/m" in line]
