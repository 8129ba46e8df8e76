"""An identified model as a URDF: for simulators, planners and controllers that know no other."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.deploy.export.exported import require_new
from hil.deploy.identified_parameters import IdentifiedParameters, identified_parameters
from hil.deploy.urdf_edit import edited
from hil.deploy.urdf_text import dynamics, inertial, written
from hil.dynamics import RobotModel
from hil.errors import FitError
from hil.identify.base import RobotEstimator

EXACT = 1e-9
"""Largest difference of what is read back, as a share of the largest torque."""


@dataclass(frozen=True, slots=True, eq=False)
class UrdfExport:
    """What was written.

    Attributes:
        out: The file.
        joint_names: Length n.
        found: The parameters in it.
        round_trip: Largest torque difference of the file read back, as a share of the largest.
        edited: Whether the robot's own URDF was edited, or one was made for it.
        notes: For people.
    """

    out: Path
    joint_names: tuple[str, ...]
    found: IdentifiedParameters
    round_trip: float
    edited: bool
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil export --to urdf --json`."""
        n = len(self.joint_names)
        bodies = self.found.inertial[: 10 * n].reshape(n, 10)
        return {
            "out": str(self.out),
            "edited": self.edited,
            "own_parameters": self.found.own,
            "joint_names": list(self.joint_names),
            "mass_kg": bodies[:, 0].tolist(),
            "com_m": (bodies[:, 1:4] / bodies[:, :1]).tolist(),
            "rotor_inertia_kgm2": self.found.inertial[10 * n :].tolist(),
            "coulomb_nm": self.found.coulomb.tolist(),
            "viscous_nms_rad": self.found.viscous.tolist(),
            "mismatch_nm": self.found.mismatch.tolist(),
            "round_trip": self.round_trip,
            "notes": list(self.notes),
        }


def export_urdf(model: RobotEstimator, out: Path) -> UrdfExport:
    """Write the arm of a fitted model as a URDF, and read it back.

    Args:
        model: With a rigid part; loads are not part of it.
        out: The file to be made.

    Raises:
        FitError: The model has no rigid part, or what is read back is not what was written.
        PluginError: Consistent parameters have to be found and cvxpy is not installed.
        RecordingError: The file exists already.
    """
    require_new(out)
    robot, found = model.robot_, identified_parameters(model)
    own = robot.arm is None
    if own:
        parts = range(robot.n)
        content = edited(
            Path(robot.name).read_bytes(),
            {robot.joint_names[j]: inertial(found.inertial[10 * j : 10 * j + 10]) for j in parts},
            {robot.joint_names[j]: dynamics(found, j) for j in parts},
        )
    else:
        content = written(robot, found, f"identified: {model.estimator}").encode()
    draft = out.with_name(f".{out.stem}.{os.getpid()}.urdf")
    try:
        draft.write_bytes(content)
        difference = _read_back(draft, robot, found)
        draft.replace(out)
    finally:
        draft.unlink(missing_ok=True)
    return UrdfExport(out, robot.joint_names, found, difference, own, _notes(robot, found, own))


def _read_back(path: Path, robot: RobotModel, found: IdentifiedParameters) -> float:
    """Largest torque difference as a share of the largest torque.

    Raises:
        FitError: It is more than rounding.
    """
    again = RobotModel.from_urdf(
        path, gravity=robot.gravity_vector.tolist(), flange=str(robot.to_dict()["flange"])
    )
    motion = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 50, robot.n))
    wanted = (robot.regressor(*motion, rotor=True) @ found.inertial).reshape(50, robot.n)
    difference = np.max(np.abs(again.inverse_dynamics(*motion) - wanted)) / np.max(np.abs(wanted))
    if not difference < EXACT:
        raise FitError(
            f"the URDF read back has other torques, by {difference:.1g} of the largest",
            hint="is the robot's URDF one that hil reads as it is? Please report this",
        )
    return float(difference)


def _notes(robot: RobotModel, found: IdentifiedParameters, own: bool) -> tuple[str, ...]:
    notes = list(found.notes)
    if np.any(found.inertial[10 * robot.n :] > 0):
        notes.append("rotor inertias are in armature=…, which is no URDF: hil reads it, others not")
    if own:
        notes.append("paths of meshes are as they were: keep the file beside the original")
    return tuple(notes)
