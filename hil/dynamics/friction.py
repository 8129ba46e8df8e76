"""Friction columns of a regressor, used by all estimators that are linear in friction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hil.core import FloatArray


def friction_terms(qd: FloatArray, sign_width: float = 0.01) -> dict[str, FloatArray]:
    """Return the Coulomb, viscous and offset terms of every joint, each (N, n).

    Args:
        qd: (N, n) joint velocities [rad/s].
        sign_width: Width of tanh(qd / width) [rad/s], which replaces sign(qd) because recorded
            velocities at standstill are noise or exactly 0. A `sign_width` of 0 gives the hard sign
            function.
    """
    sign = np.tanh(qd / sign_width) if sign_width > 0 else np.sign(qd)
    return {"coulomb": sign, "viscous": np.array(qd), "offset": np.ones_like(qd)}


def joint_columns(terms: Mapping[str, FloatArray]) -> FloatArray:
    """Return the regressor (N·n, k·n) of k friction terms (N, n), with k columns per joint.

    The rows of the regressor are ordered by sample, as in `RobotModel.regressor`. The column with
    index j·k + i is term i of joint j.
    """
    stacked = np.stack(list(terms.values()), axis=-1)
    samples, joints, k = stacked.shape
    columns = np.zeros((samples, joints, joints, k))
    diagonal = np.arange(joints)
    columns[:, diagonal, diagonal] = stacked
    return columns.reshape(samples * joints, joints * k)
