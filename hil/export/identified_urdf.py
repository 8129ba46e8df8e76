"""An identified model as a URDF: for simulators, planners and controllers that know no other."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FitError
from hil.dynamics import GRAVITY, RobotModel
from hil.estimators import RobotEstimator
from hil.export.exported import Exported, require_new, write_file
from hil.export.identified_parameters import IdentifiedParameters, identified_parameters
from hil.export.urdf_check import Miss, missed, require_near, words
from hil.export.urdf_edit import edited
from hil.export.urdf_text import dynamics, inertial, plain, written


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class UrdfExport(Exported):
    """What was written, beside what every export says.

    Attributes:
        found: The parameters in it.
        miss: Of the file read back, against the model.
        edited: Whether the robot's own URDF was edited, or one was made for it.
        turns: Which joints turn; the others slide.
    """

    found: IdentifiedParameters
    miss: Miss
    edited: bool
    turns: tuple[bool, ...]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil export --to urdf --json`: every export's, and what is in the file.

        Of joints that slide, what is in N·m is in N, and what is in N·m·s/rad in N·s/m.
        """
        n = len(self.joint_names)
        bodies = self.found.inertial[: 10 * n].reshape(n, 10)
        return Exported.to_dict(self) | {
            "edited": self.edited,
            "own_parameters": self.found.own,
            "exact": self.found.exact,
            "joint_types": ["revolute" if turns else "prismatic" for turns in self.turns],
            "mass_kg": bodies[:, 0].tolist(),
            "com_m": (bodies[:, 1:4] / bodies[:, :1]).tolist(),
            "rotor_inertia_kgm2": self.found.inertial[10 * n :].tolist(),
            "coulomb_nm": self.found.coulomb.tolist(),
            "viscous_nms_rad": self.found.viscous.tolist(),
            "mismatch_nm": self.found.mismatch.tolist(),
            "rigid_miss": self.miss.rigid.tolist(),
            "friction_miss": self.miss.friction.tolist(),
        }


def export_urdf(model: RobotEstimator, out: Path, *, unchecked: bool = False) -> UrdfExport:
    """Write the arm of a fitted model as a URDF that, read back, has the model's torques.

    Args:
        model: With a rigid part; loads are not part of it.
        out: The file to be made.
        unchecked: Write it although what is read back is not near the model; it is still said by
            how much.

    Raises:
        FitError: The model has no rigid part, one that no URDF can say, or what is read back is not
            near what the model says.
        PluginError: Consistent parameters have to be found and cvxpy is not installed.
        RecordingError: The file exists already, or cannot be made.
    """
    require_new(out)
    robot = model.robot_
    _require_joints(robot)
    found = identified_parameters(model)
    content = _content(model, found)
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder, "arm.urdf")
        draft.write_bytes(content)
        miss = missed(draft, model)
    if not unchecked:
        require_near(miss, found, robot.joint_names)
    write_file(content, out)
    own = robot.arm is None
    made = "the robot's own URDF, edited" if own else "made from the built-in arm"
    return UrdfExport(
        out=out,
        files=(out.name,),
        joint_names=robot.joint_names,
        effort_unit="",
        parts=f"{model.estimator}, {made}",
        checked=words(miss, found),
        notes=_notes(robot, found, own),
        found=found,
        miss=miss,
        edited=own,
        turns=tuple(bool(turns) for turns in robot.joint_geometry().turns),
    )


def _require_joints(robot: RobotModel) -> None:
    """Refuse motors that move more than one joint.

    Raises:
        FitError: It is such an arm.
    """
    if getattr(robot, "joints_per_motor", None) is not None:
        raise FitError(
            f"{robot.name} is told in the angles of its motors, some of which move two joints; a "
            "URDF knows joints with a rotor and a friction of their own",
            hint="take --to json, which has `joints_per_motor`, or fit the arm in its joints: "
            f"robot: {robot.name.split('@')[0]}",
        )


def _content(model: RobotEstimator, found: IdentifiedParameters) -> bytes:
    robot = model.robot_
    if robot.arm is not None:
        comment = " ".join([f"identified: {model.estimator}.", *_mount(robot)])
        return written(robot, found, comment).encode()
    parts = range(robot.n)
    content = edited(
        Path(robot.name).read_bytes(),
        {robot.joint_names[j]: inertial(found.inertial[10 * j : 10 * j + 10]) for j in parts},
        {robot.joint_names[j]: dynamics(found, j) for j in parts},
    )
    for words_ in _mount(robot):
        before, end, behind = content.rpartition(b"</robot>")
        content = before + f"<!-- {plain(words_)} -->\n".encode() + end + behind
    return content


def _mount(robot: RobotModel) -> tuple[str, ...]:
    """How the arm is mounted, which no word of URDF says; nothing if upright."""
    if np.allclose(robot.gravity_vector, GRAVITY, atol=1e-9):
        return ()
    x, y, z = (float(one) for one in robot.gravity_vector)
    told = f"({x:.6g}, {y:.6g}, {z:.6g}) m/s2"
    return (f"URDF has no gravity: set {told} in the base frame after loading",)


def _notes(robot: RobotModel, found: IdentifiedParameters, own: bool) -> tuple[str, ...]:
    notes = [*found.notes, *_mount(robot)]
    if np.any(found.inertial[10 * robot.n :] > 0):
        notes.append("rotor inertias are in armature=…, which is no URDF: hil reads it, others not")
    if not np.all(robot.joint_geometry().turns):
        notes.append("of joints that slide, torques are forces [N] and damping is in N·s/m")
    if own:
        notes.append("paths of meshes are as they were: keep the file beside the original")
    return tuple(notes)
