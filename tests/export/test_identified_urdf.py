"""Identified models as URDFs: MuJoCo's torques, bytes that stay, links that exist."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import FitError, RecordingError
from hil.dynamics import RobotModel
from hil.dynamics.inertial import is_consistent
from hil.estimators.rigid_linear import RigidWls
from hil.export.urdf import edited, export_urdf, roll_pitch_yaw
from tests.support.dynamics_arms import motion, mujoco_torques, urdf, written
from tests.support.synthetic_motion import (
    COULOMB,
    LOAD,
    ROTORS,
    VISCOUS,
    fourier,
    moving,
    nominal,
    plant,
)

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
    return RigidWls().fit(moving(1, 2, 3), nominal())


@pytest.fixture(scope="module")
def exported(model, tmp_path_factory):
    return export_urdf(model, tmp_path_factory.mktemp("urdf") / "robot.urdf")


@pytest.mark.thorough
def test_mujoco_finds_the_torques_of_the_true_arm_in_the_file(exported) -> None:
    mujoco = pytest.importorskip("mujoco")
    peer = mujoco.MjModel.from_xml_path(str(exported.out))
    peer.dof_armature[:] = RobotModel.from_urdf(exported.out).rotor_inertia
    peer.dof_damping[:], peer.dof_frictionloss[:] = 0.0, 0.0
    peer.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    q, qd, qdd = motion(40)
    wanted = plant().inverse_dynamics(q, qd, qdd)
    assert mujoco_torques(peer, q, qd, qdd) == pytest.approx(wanted, abs=1e-4)


def test_the_file_read_back_has_the_torques_that_were_written(exported) -> None:
    again, motions = RobotModel.from_urdf(exported.out), motion(40)
    wanted = nominal().regressor(*motions) @ exported.found.inertial
    assert again.inverse_dynamics(*motions).ravel() == pytest.approx(wanted, abs=1e-9)
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
def test_a_robots_own_urdf_is_edited(model, tmp_path: Path) -> None:
    path = written(tmp_path, urdf("ur5"))
    own = RobotModel.from_urdf(path)
    found = export_urdf(RigidWls().fit(moving(1, 2, 3), own), tmp_path / "identified.urdf")
    assert found.edited
    text, before = found.out.read_text("utf-8"), path.read_text("utf-8")
    stripped = re.sub(r"<inertial>.*?</inertial>|\s*<dynamics [^>]*/>\s*", "", text)
    assert stripped == re.sub(r"<inertial>.*?</inertial>", "", before)
    motions = motion(20)
    wanted = plant().inverse_dynamics(*motions)
    again = RobotModel.from_urdf(found.out)
    assert again.inverse_dynamics(*motions) == pytest.approx(wanted, abs=1e-4)


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


@pytest.mark.parametrize("angles", [(0.3, -0.2, 2.9), (1.0, np.pi / 2, 0.5), (2.0, -np.pi / 2, 0)])
def test_angles_give_the_rotation_back(angles) -> None:
    R = Rotation.from_euler("xyz", angles).as_matrix()
    again = Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix()
    assert again == pytest.approx(R, abs=1e-12)


@pytest.mark.thorough
def test_parameters_of_bodies_are_written_as_they_are(model, tmp_path: Path) -> None:
    class Bodies(RigidWls):
        pass

    other = Bodies().fit(moving(1), nominal())
    other.inertial_ = plant().parameters()
    found = export_urdf(other, tmp_path / "own.urdf", unchecked=True)
    assert found.found.own
    again = RobotModel.from_urdf(found.out).parameters()
    assert again == pytest.approx(plant().parameters(), abs=1e-12)


@pytest.mark.thorough
def test_noise_leaves_links_that_exist_and_says_by_how_much_they_are_off(tmp_path: Path) -> None:
    noisy = RigidWls().fit(moving(1, noise_a=0.3), nominal())
    found = export_urdf(noisy, tmp_path / "noisy.urdf", unchecked=True)
    assert np.all(is_consistent(found.found.inertial[:60].reshape(6, 10)))
    assert "come nearest" in found.notes[0]
    assert np.max(found.found.mismatch) > 1e-3


def test_files_are_not_overwritten_and_models_without_links_refused(model, tmp_path: Path) -> None:
    class Boxed(RigidWls):
        def predict(self, dataset):
            return replace(super().predict(dataset), components={})

    out = tmp_path / "robot.urdf"
    with pytest.raises(FitError, match="does not tell gravity and inertia apart"):
        export_urdf(Boxed().fit(moving(1), nominal()), out)
    assert list(tmp_path.iterdir()) == []
    out.write_text("mine", "utf-8")
    with pytest.raises(RecordingError, match="exists already"):
        export_urdf(model, out)


@pytest.mark.parametrize("as_json", [True, False])
def test_the_command_tells_what_is_in_the_file(
    exported, model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, as_json: bool
) -> None:
    out = tmp_path / "r.urdf"
    monkeypatch.setattr("hil.export.urdf.export_urdf", lambda *_, **__: exported)
    folder = model.save(tmp_path / "model")
    arguments = ["export", str(folder), "--to", "urdf", "-o", str(out)]
    arguments += ["--json"] if as_json else []
    text = CliRunner().invoke(app, arguments, catch_exceptions=False).stdout
    if as_json:
        told = json.loads(text)
        assert told["rotor_inertia_kgm2"][2:] == pytest.approx(ROTORS[2:].tolist(), abs=0.02)
        assert told["checked"] == exported.checked
        assert told["files"] == ["robot.urdf"]
    else:
        assert "wrist_3_joint" in text
        assert f"{exported.out}: rigid-wls, made from the built-in arm" in text
        assert text.splitlines()[-1].startswith("  read back, against the model: gravity and in")


@pytest.mark.thorough
@pytest.mark.parametrize("load", [None, LOAD])
def test_the_command_for_loads_tells_the_load_or_that_none_shows(model, load, tmp_path) -> None:
    from hil.importers import import_recording

    run = moving(5, load=load)
    t, q, qd, _ = fourier(5)
    np.savetxt(tmp_path / "run.csv", np.column_stack([t, q, qd, run["effort"]]), delimiter=",")
    (tmp_path / "map.yaml").write_text(MAP, "utf-8")
    import_recording(
        tmp_path / "run.csv", map_file=tmp_path / "map.yaml", out=tmp_path / "run.mcap"
    )
    folder = model.save(tmp_path / "model")
    done = CliRunner().invoke(
        app, ["payload", str(folder), str(tmp_path / "run.mcap")], catch_exceptions=False
    )
    lines = done.stdout.splitlines()
    assert lines[0].startswith("load in 600 samples")
    if load is None:
        assert lines[-1].startswith("no load shows: 0.0")
    else:
        told = re.findall(r"(?:mass_kg: |--payload )([0-9.]+)", "\n".join(lines[-2:]))
        assert np.array(told, dtype=float) == pytest.approx([load.mass] * 2, rel=0.05)


MAP = """
hil_map: 1
description: synthetic
format: csv
robot: ur5
joint_names: [shoulder_pan_joint, shoulder_lift_joint, elbow_joint, wrist_1_joint, wrist_2_joint,
              wrist_3_joint]
effort_kind: current
columns:
  t: {columns: 1}
  q: {columns: "2:7", unit: rad}
  qd: {columns: "8:13", unit: rad/s}
  effort: {columns: "14:19", unit: A}
"""
