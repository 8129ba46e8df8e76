"""URDFs are held against what the model predicts, not against what was meant to be written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import FitError, RecordingError
from hil.dynamics import RobotModel
from hil.dynamics.inertial import about_centre, body_parameters
from hil.estimators import estimator
from hil.estimators.rigid_linear import RigidWls
from hil.export import identified_parameters, urdf
from hil.export.urdf import export_urdf
from tests.support.export_arms import fitted_arm, fitted_robot
from tests.support.synthetic_motion import dwelling, moving, nominal

WALL = (9.81, 0.0, 0.0)


@pytest.fixture(scope="module")
def model() -> RigidWls:
    return RigidWls().fit(moving(1, 2, 3), nominal())


def heavier(honest):
    return lambda body: honest(body * 1.3)


def swapped(honest):
    def text(found, j):
        return honest(replace(found, coulomb=found.viscous, viscous=found.coulomb), j)

    return text


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "bent", "words"),
    [
        ("inertial", heavier, "misses the model's gravity and inertia by 0.3"),
        ("dynamics", swapped, "friction and damping of the URDF read back are not those nearest"),
    ],
)
def test_a_file_that_says_something_else_is_not_written(
    name, bent, words, model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(urdf, name, bent(getattr(urdf, name)))
    with pytest.raises(FitError, match=words):
        export_urdf(model, tmp_path / "a.urdf")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_friction_that_was_asked_for_wrongly_is_found_out(model, tmp_path, monkeypatch) -> None:
    honest = identified_parameters.plain_friction
    monkeypatch.setattr(identified_parameters, "plain_friction", lambda m: honest(m)[::-1])
    with pytest.raises(FitError, match="are not those nearest to the model's: off by"):
        export_urdf(model, tmp_path / "a.urdf")


@pytest.mark.thorough
def test_a_model_that_is_no_rigid_body_is_refused_unless_wanted(tmp_path: Path) -> None:
    class Odd(RigidWls):
        def predict(self, dataset):
            told = super().predict(dataset)
            parts = dict(told.components)
            parts["inertia"] = parts["inertia"] + 0.3 * np.abs(parts["gravity"])
            return replace(told, components=parts)

    odd = Odd().fit(moving(1, 2, 3), nominal())
    with pytest.raises(FitError, match=r"largest torque they miss: .*shoulder_lift_joint \d+%"):
        export_urdf(odd, tmp_path / "a.urdf")
    told = export_urdf(odd, tmp_path / "a.urdf", unchecked=True)
    assert told.checked.startswith("read back, against the model: gravity and inertia missed by ")
    assert told.miss.rigid.max() > 0.05
    assert not told.found.exact


@pytest.mark.thorough
def test_the_model_under_a_network_gives_its_own_links(model, tmp_path: Path) -> None:
    network = RigidWls().fit(moving(1, 2, 3), nominal())
    network.base_ = RigidWls().fit(moving(1, 2, 3), nominal())
    network.base_.inertial_ = export_urdf(model, tmp_path / "a.urdf").found.inertial
    told = export_urdf(network, tmp_path / "b.urdf")
    assert told.found.own
    assert told.miss.rigid.max() < 1e-9


@pytest.mark.thorough
def test_folders_are_made_and_slips_of_paths_are_one_error(model, tmp_path: Path) -> None:
    told = export_urdf(model, tmp_path / "new" / "deep" / "a.urdf")
    assert told.out.is_file()
    (tmp_path / "file").write_text("mine")
    slips = [tmp_path / "file" / "a.urdf", tmp_path / f"{'n' * 300}.urdf", Path("/proc/a.urdf")]
    for out in slips:
        with pytest.raises(RecordingError, match="cannot write"):
            export_urdf(model, out)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["file", "new"]
    export_urdf(model, tmp_path / f"{'n' * 230}.urdf")


@pytest.mark.thorough
@pytest.mark.parametrize("own", [False, True], ids=["built in", "its own URDF"])
def test_walls_and_ceilings_are_said_so(own: bool, model, tmp_path: Path) -> None:
    robot = RobotModel.from_arm("ur5", gravity=WALL)
    if own:
        robot = RobotModel.from_urdf(export_urdf(model, tmp_path / "own.urdf").out, gravity=WALL)
    told = export_urdf(fitted_robot(robot), tmp_path / "wall.urdf")
    said = "URDF has no gravity: set (9.81, 0, 0) m/s2 in the base frame after loading"
    assert said in told.notes
    assert said in told.out.read_text("utf-8")
    assert not [
        note for note in export_urdf(model, tmp_path / "up.urdf").notes if "gravity" in note
    ]
    read = pin.buildModelFromUrdf(str(told.out))
    read.gravity.linear = np.array(WALL)
    q = np.full(6, 0.3)
    found = pin.computeGeneralizedGravity(read, read.createData(), q)
    assert found == pytest.approx(robot.gravity(q[None])[0], abs=1e-6)


def test_motors_that_move_two_joints_are_refused(tmp_path: Path) -> None:
    motors = fitted_arm("tx40@motors", tmp_path)
    with pytest.raises(FitError, match="some of which move two joints") as refused:
        export_urdf(motors, tmp_path / "a.urdf")
    assert "robot: tx40" in str(refused.value.hint)


@pytest.mark.thorough
def test_joints_that_slide_are_told_in_their_units(tmp_path: Path) -> None:
    slides = fitted_arm("sliding", tmp_path)
    folder = slides.save(tmp_path / "model")
    command = ["export", str(folder), "--to", "urdf", "-o", str(tmp_path / "b.urdf")]
    lines = CliRunner().invoke(app, command, catch_exceptions=False).stdout.splitlines()
    (row,) = [line for line in lines if line.startswith("r ")]
    assert "3.000 N " in row
    assert "2.000 N·s/m" in row
    assert not [line for line in lines if line.startswith("x ") and "N·s/m" in line]


def test_models_of_arms_at_rest_are_told_where_to_go(tmp_path: Path) -> None:
    still = estimator("static-wls").fit(dwelling(80), nominal())
    with pytest.raises(FitError, match="does not tell gravity and inertia apart") as refused:
        urdf.export_urdf(still, tmp_path / "a.urdf")
    assert "--to json" in str(refused.value.hint)


def test_a_body_about_its_centre_is_the_body_about_the_origin() -> None:
    inertia = np.array([[0.03, 0.001, -0.002], [0.001, 0.04, 0.003], [-0.002, 0.003, 0.05]])
    mass, com, about = about_centre(body_parameters(2.0, (0.1, -0.2, 0.3), inertia))
    assert mass == 2.0
    assert com == pytest.approx([0.1, -0.2, 0.3], abs=1e-15)
    assert about == pytest.approx(inertia, abs=1e-15)
