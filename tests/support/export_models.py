"""Models of the kinds that are exported, each fitted once."""

from __future__ import annotations

from functools import cache

from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from tests.export.test_c import KINDS
from tests.support.residual_models import model as residual
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import moving, nominal


@cache
def fitted(kind: str) -> RobotEstimator:
    """One of `KINDS`, or `residual`."""
    if kind == "residual":
        return residual()
    name = kind.split()[0]
    data = remembering(1, 2, 3) if name == "rigid-hysteresis" else moving(1, 2, 3)
    return estimator(name, **KINDS[kind]).fit(data, nominal())
