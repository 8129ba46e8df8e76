"""Models of the kinds that are exported, each fitted once."""

from __future__ import annotations

from functools import cache

from residual_models import model as residual
from synthetic_memory import remembering
from synthetic_motion import moving, nominal
from test_export_c import KINDS

from hil.estimators import estimator
from hil.estimators.base import RobotEstimator


@cache
def fitted(kind: str) -> RobotEstimator:
    """One of `KINDS`, or `residual`."""
    if kind == "residual":
        return residual()
    name = kind.split()[0]
    data = remembering(1, 2, 3) if name == "rigid-hysteresis" else moving(1, 2, 3)
    return estimator(name, **KINDS[kind]).fit(data, nominal())
