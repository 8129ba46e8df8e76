"""Base parameters chosen as is usual: by a pivoted QR of a random regressor."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from hil.dynamics import BaseParameters, RobotModel


def pivoted_base(robot: RobotModel, seed: int = 0) -> BaseParameters:
    """Return the base parameters that a pivoted QR of random samples selects."""
    samples = np.random.default_rng(seed).uniform(-np.pi, np.pi, (3, 500, robot.n))
    W = robot.regressor(*samples, rotor=False)
    _, R, order = scipy.linalg.qr(W, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    rank = int(np.sum(size > 1e-9 * size[0]))
    kept, left = np.sort(order[:rank]), np.sort(order[rank:])
    K = np.asarray(np.linalg.lstsq(W[:, kept], W[:, left], rcond=None)[0], dtype=np.float64)
    names = robot.parameter_names(rotor=False)
    return BaseParameters(kept, left, K, tuple(names[i] for i in kept))
