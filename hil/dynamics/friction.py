"""Friction as columns of a regressor, shared by all estimators that are linear in friction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hil.core import FloatArray


def friction_terms(qd: FloatArray, sign_width: float = 0.01) -> dict[str, FloatArray]:
    """Coulomb, viscous and offset terms of every joint, each (N, n).

    Args:
        qd: (N, n) joint velocities [rad/s].
        sign_width: Velocity scale of tanh(qd / width), which stands for sign(qd) [rad/s]: recorded
            velocities at rest are noise, or exactly 0. 0 gives the hard sign.
    """
    sign = np.tanh(qd / sign_width) if sign_width > 0 else np.sign(qd)
    return {"coulomb": sign, "viscous": np.array(qd), "offset": np.ones_like(qd)}


def joint_columns(terms: Mapping[str, FloatArray]) -> FloatArray:
    """(N·n, k·n) regressor of k terms (N, n): every joint has k columns of its own, joint by joint.

    Rows are sample-major as in `RobotModel.regressor`; column j·k + i is term i of joint j.
    """
    stacked = np.stack(list(terms.values()), axis=-1)
    samples, joints, k = stacked.shape
    columns = np.zeros((samples, joints, joints, k))
    diagonal = np.arange(joints)
    columns[:, diagonal, diagonal] = stacked
    return columns.reshape(samples * joints, joints * k)
