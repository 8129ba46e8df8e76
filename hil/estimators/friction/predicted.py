"""A friction law along recorded motion."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil.data import Dataset, FilterSettings
from hil.estimators.friction.law import FrictionLaw
from hil.estimators.friction.memory import path_steps
from hil.estimators.friction.series import motions, smoothed


def predicted_friction(
    law: FrictionLaw, data: Dataset, transmitted: FloatArray, filters: FilterSettings
) -> dict[str, FloatArray]:
    """Parts of the friction law, each (N, n) [N·m], as far as the filtered motion goes.

    Args:
        law: As it was found.
        data: Prepared with `filters`.
        transmitted: (N, n) torque through the gears [N·m].
        filters: The velocity's cut-off smooths what is predicted from it.
    """
    out: dict[str, FloatArray] = {}
    for condition, rows, motion in motions(
        data, path_steps(data), transmitted, law.shapes, law.celsius
    ):
        for name, torque in law.torques(motion).items():
            whole = out.setdefault(name, np.zeros_like(transmitted))
            t = data["t"][rows]
            whole[rows] = smoothed(torque, condition, t, filters, cutoff=filters.velocity)
    return out
