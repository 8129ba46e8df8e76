"""Whether those who are timed say what the model says; else their times mean nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hil.arms.payload import Payload
from hil.control.predictor import Predictor
from hil.core.errors import FitError
from hil.estimators.base import RobotEstimator
from hil.export.agreement import AGREES, LOAD, golden_of, scale_of

TIMED, OFF_BY = "_p50_ns", "_off_by"


def off_by(model: RobotEstimator, *, compiled: bool) -> float:
    """Largest difference of a `Predictor` from the model, as a share of a joint's largest."""
    golden = golden_of(model)
    scale, worst = scale_of(golden.bare, golden.loaded), 0.0
    for load, wanted in ((Payload(), golden.bare), (LOAD, golden.loaded)):
        predictor = Predictor(model, load, compiled=compiled)
        rows = zip(golden.q, golden.qd, golden.qdd, strict=True)
        found = np.array([predictor.step(*row).copy() for row in rows])
        worst = max(worst, float(np.max(np.abs(found - wanted) / scale)))
    return worst


def require_agreement(figures: Mapping[str, float]) -> None:
    """Everybody who was timed was compared, and agrees.

    Raises:
        FitError: Somebody was not, or does not.
    """
    for timed in (name for name in figures if name.endswith(TIMED)):
        who = timed.removesuffix(TIMED)
        off = figures.get(f"{who}{OFF_BY}", np.nan)
        if not off <= AGREES:
            raise FitError(
                f"{who} was timed, but is off the model by {off:.1e} of a joint's largest effort",
                hint=f"more than {AGREES:g} is a fault of what it was made with: please report it",
            )
