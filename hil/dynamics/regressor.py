"""Joint-torque regressors of many samples at once.

The equations of motion are linear in the inertial parameters of every link. In the frame of link
i, with the acceleration a of its origin (gravity taken off), its angular velocity ω and
acceleration α, the force and the torque about the origin are (Atkeson, An & Hollerbach 1986)

    f = m a + K mc            K = [α]× + [ω]×²
    n = mc × a + I α + ω × I ω.

Joint j ≤ i feels w·n + v·f, with w its axis and v the velocity that its unit speed gives to the
origin of frame i. So axes and velocities travel outwards with the recursion, and each link adds
ten columns for itself and the joints before it; nothing is summed up on the way back.

Where numba is installed the recursion is compiled (`hil.dynamics.compiled`), four to five times as
fast as a loop over Pinocchio; elsewhere, and for a few samples, it is that loop. The two agree to
rounding.
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
"""Samples from which compiled code is used. Loading it takes as long as a loop over 50,000 samples,
compiling it, once on a machine, as long as one over a million: not for short recordings."""


class Regressor:
    """Chosen columns of the regressor of one robot.

    Holds scratch memory: share it between processes, not between threads.

    Args:
        model: The robot.
        chain: Its constants.
        columns: (k,) which of the 11·n columns of `RobotModel.parameters` are wanted, ascending.

    Raises:
        DataError: There is no such column, or they do not ascend.
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
        """(N·n, k) for motions (N, n), sample-major."""
        out = np.zeros((len(q), q.shape[1], len(self.columns)))
        if compiles(len(q)):
            from hil.dynamics.compiled import fill_regressor

            fill_regressor(self._chain, q, qd, qdd, self._first, self._kinds, out)
        else:
            self._loop(q, qd, qdd, out)
        # Pinocchio leaves the rotor inertias out; their columns hold qdd.
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
            f"the columns {columns} of a regressor of {count} columns do not ascend",
            hint="name each column once, from left to right",
        )
    return columns


def compiles(samples: int) -> bool:
    """Whether so many samples are for compiled recursions, and there is numba to compile them."""
    return samples >= COMPILED_FROM and _has_numba()


@cache
def _has_numba() -> bool:
    return find_spec("numba") is not None
