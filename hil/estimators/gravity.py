"""Two ways to write gravity as columns: shared by all joints, or eq. 15 joint by joint."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hil.core import BoolArray, FitError, FloatArray
from hil.dynamics import RobotModel, base_parameters

UR_JOINTS = 6


class GravityForm(Protocol):
    """Columns that gravity is a linear combination of.

    Attributes:
        names: Length p.
        joint: The joint, from 0, that a column belongs to alone; None for shared columns.
    """

    names: tuple[str, ...]
    joint: tuple[int | None, ...]

    def columns(self, q: FloatArray) -> FloatArray:
        """(N·n, p), sample-major, for positions (N, n)."""


class BaseGravity:
    """The arm's base gravity parameters: first moments that gravity can tell apart."""

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._base = base_parameters(robot, gravity_only=True)
        self.names = tuple(self._base.names)
        self.joint: tuple[int | None, ...] = (None,) * len(self.names)

    def columns(self, q: FloatArray) -> FloatArray:
        """(N·n, p), sample-major."""
        reduced: FloatArray = self._base.reduce(self._robot.gravity_regressor(q))
        return reduced


class PaperGravity:
    """φ₂…φ₅ of the static paper's eq. 15, for Universal Robots arms in their own joint angles.

    Six columns for joint 2, three for 3, two for 4, one for 5; joints 1 and 6 have none. Four
    would do for joint 2: the printed six split two sums whose parts have equal coefficients.

    Raises:
        FitError: The robot does not have six joints, or its base is not level.
    """

    names = (
        *(f"joint2.phi{i}" for i in range(1, 7)),
        *(f"joint3.phi{i}" for i in range(1, 4)),
        *(f"joint4.phi{i}" for i in range(1, 3)),
        "joint5.phi1",
    )
    joint: tuple[int | None, ...] = (1, 1, 1, 1, 1, 1, 2, 2, 2, 3, 3, 4)

    def __init__(self, robot: RobotModel) -> None:
        if robot.n != UR_JOINTS:
            raise FitError(
                f"the paper's form is for six-joint UR arms, {robot.name} has {robot.n} joints",
                hint="use form: shared",
            )
        if np.any(robot.gravity_vector[:2]):
            raise FitError(
                "the paper's form is for arms on a level base, but gravity is "
                f"{robot.gravity_vector.tolist()} m/s² in the base frame",
                hint="use form: shared",
            )

    def columns(self, q: FloatArray) -> FloatArray:
        """(6·N, 12), sample-major, each joint's functions in its own columns."""
        out = np.zeros((len(q), UR_JOINTS, len(self.names)))
        start = 0
        for joint, functions in enumerate(paper_functions(q), start=1):
            out[:, joint, start : start + functions.shape[1]] = functions
            start += functions.shape[1]
        return out.reshape(-1, len(self.names))


PROBES = 32
"""Random poses that show which joints gravity depends on, and how far its columns can reach."""


def reach_of(form: GravityForm, n_joints: int) -> tuple[BoolArray, FloatArray]:
    """What there is to excite.

    Returns:
        (n,) which joints the columns depend on, and (p,) by how much each column can change.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (PROBES, n_joints))
    columns = form.columns(q)
    turned = [form.columns(q + step) for step in np.eye(n_joints)]
    depends = np.array([not np.allclose(columns, other) for other in turned])
    cube = columns.reshape(PROBES, n_joints, -1)
    return depends, np.asarray(np.ptp(cube, axis=0).max(axis=0))


def paper_functions(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Eq. 15: φ₂ (N, 6), φ₃ (N, 3), φ₄ (N, 2) and φ₅ (N, 1) for positions (N, 6)."""
    q2, q3, q4, q5 = q[:, 1], q[:, 2], q[:, 3], q[:, 4]
    q23, q234 = q2 + q3, q2 + q3 + q4
    wrist = np.sin(q234), np.cos(q234) * np.sin(q5)
    phi2 = (
        np.cos(q23) * np.cos(q4) * np.sin(q5),
        np.cos(q23) * np.sin(q4),
        np.cos(q23),
        np.cos(q2),
        np.sin(q23) * np.sin(q4) * np.sin(q5),
        np.sin(q23) * np.cos(q4),
    )
    phi3 = (wrist[0], np.cos(q23), wrist[1])
    phi5 = (np.sin(q234) * np.cos(q5),)
    return (
        np.stack(phi2, axis=1),
        np.stack(phi3, axis=1),
        np.stack(wrist, axis=1),
        np.stack(phi5, axis=1),
    )
