"""Joint-torque regressors, computed for many samples at once.

The equations of motion of an arm are linear in the inertial parameters of every link. In the frame
of link i, let a be the acceleration of the frame's origin (minus gravity), ω the angular velocity
of the link and α its angular acceleration. The force and the torque on link i about the origin are
(Atkeson, An & Hollerbach 1986)

    f = m a + K mc            K = [α]× + [ω]×²
    n = mc × a + I α + ω × I ω.

The torque of joint j ≤ i due to link i is w·n + v·f. In this torque, w is the axis of joint j, and
v is the velocity of the origin of frame i per unit speed of joint j. The recursion propagates axes
and velocities outwards. Each link adds ten columns for its own joint and all joints before it, so
no backward pass is needed.

If numba is installed, the recursion is compiled (`hil.dynamics.compiled`), which is four to five
times as fast as a loop over Pinocchio. The loop over Pinocchio is used without numba, and for few
samples. Recursion and loop give the same regressor up to rounding.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import numpy as np
import pinocchio as pin

from hil.core import DataError, FloatArray, IntArray
from hil.dynamics.chain import Chain
from hil.dynamics.inertial import PARAMETERS

BODY = len(PARAMETERS)

COMPILED_FROM = 8192
"""Minimum number of samples for which the compiled code is used.

Loading the compiled code takes as long as a loop over 50,000 samples. Compiling the code, which
happens one time per machine, takes as long as a loop over a million samples. Compiled code is
therefore not used for short recordings.
"""


class Regressor:
    """Calculator of selected regressor columns of one robot.

    An instance contains scratch memory, so it can be shared between processes, but not between
    threads.

    Args:
        model: Pinocchio model of the robot.
        chain: Joint constants of the robot.
        columns: (k,) ascending indices of the columns among the 11·n columns of
            `RobotModel.parameters`.

    Raises:
        DataError: A requested column does not exist, or the indices are not ascending.
    """

    def __init__(self, model: pin.Model, chain: Chain, columns: IntArray) -> None:
        n = int(model.nv)
        self.columns = _ascending(columns, (BODY + 1) * n)
        self._model, self._data, self._chain = model, model.createData(), chain
        link, kind = np.divmod(self.columns, BODY)
        self._body = np.flatnonzero(link < n)
        self._rotor = np.flatnonzero(link >= n)
        self._joint = self.columns[self._rotor] - BODY * n
        self._kinds = kind
        self._first = np.searchsorted(link, np.arange(n + 1))

    def __call__(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the selected columns (N·n, k) for motions (N, n), with rows ordered by sample."""
        out = np.zeros((len(q), q.shape[1], len(self.columns)))
        if compiles(len(q)):
            from hil.dynamics.compiled import fill_regressor

            fill_regressor(self._chain, q, qd, qdd, self._first, self._kinds, out)
        else:
            self._loop(q, qd, qdd, out)
        # Pinocchio omits the rotor inertias; their columns contain qdd.
        for place, joint in zip(self._rotor, self._joint, strict=True):
            out[:, joint, place] = qdd[:, joint]
        return out.reshape(-1, len(self.columns))

    def _loop(self, q: FloatArray, qd: FloatArray, qdd: FloatArray, out: FloatArray) -> None:
        n = q.shape[1]
        whole = len(self._body) == BODY * n
        full = out[:, :, : BODY * n] if whole else np.empty((len(q), n, BODY * n))
        for W, *sample in zip(full, q, qd, qdd, strict=True):
            W[:] = pin.computeJointTorqueRegressor(self._model, self._data, *sample)
        if not whole:
            out[:, :, self._body] = full[:, :, self.columns[self._body]]


def _ascending(columns: IntArray, count: int) -> IntArray:
    if np.any(np.diff(columns) <= 0) or not np.all((columns >= 0) & (columns < count)):
        raise DataError(
            f"the columns {columns} of a regressor with {count} columns are not in ascending order",
            hint="name each column once, from left to right",
        )
    return columns


def compiles(samples: int) -> bool:
    """Return whether compiled code is used for a number of samples; this requires numba."""
    return samples >= COMPILED_FROM and _has_numba()


@cache
def _has_numba() -> bool:
    return find_spec("numba") is not None
