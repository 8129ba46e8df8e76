"""Samples of a motion as they come: one finite number per joint, or a clear refusal."""

from __future__ import annotations

import numpy as np

from hil.core import DataError, FloatArray

MOST = 1e6
"""Beyond it no position, velocity or acceleration is taken."""

REFUSED = "a sample holds what is not finite, or beyond 1e6"
HINT = "nothing of it is remembered; look at where the motion comes from"


def as_sample(n: int, *rows: FloatArray) -> FloatArray:
    """(k, n) of k rows that are one number for each of n joints.

    Raises:
        DataError: One of them is not.
    """
    taken = np.empty((len(rows), n))
    for place, row in enumerate(rows):
        try:
            given = np.asarray(row)
        except ValueError:  # of rows that differ in length
            given = np.empty(0)
        if given.shape != (n,) or given.dtype.kind not in "iuf":
            raise DataError(
                f"a sample is one number for each of {n} joints, not {str(row)[:60]}",
                hint="give q, qd and qdd of every joint of the model's robot",
            )
        taken[place] = given
    return taken


def require_within(sample: FloatArray) -> None:
    """Refuse what is not finite, or beyond `MOST`.

    Raises:
        DataError: It is.
    """
    if not np.all(np.abs(sample) <= MOST):
        raise DataError(REFUSED, hint=HINT)
