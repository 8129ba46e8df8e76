"""The loads of a run under a model: its errors told and not told, and what was identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hil.data.dataset import Dataset
from hil.errors import FitError
from hil.identify.base import RobotEstimator
from hil.identify.payload_declared import Declaration, check_declarations
from hil.identify.payload_estimate import PayloadEstimate
from hil.identify.payload_fit import estimate_payload
from hil.identify.payload_problem import Friction, with_identified
from hil.payload import Payload
from hil.study.dynamic_methods import rmse_where
from hil.study.load_cases import LoadCase
from hil.study.separation_text import mean_of
from hil.typing import FloatArray

TOLD = ("unaware", "declared", "identified")
"""What the model is told of the load: nothing, what the spec says, what other motions say."""


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """One load.

    Attributes:
        case: Its recordings.
        errors: By `TOLD`, (n,) RMSE in N·m on the motions held out; without `identified` where
            there is no estimate.
        estimate: The identified load; None for the first one, and where it failed.
        failed: Why it did.
        check: The declaration against it; None without an estimate, or where nobody asked.
    """

    case: LoadCase
    errors: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    failed: str = ""
    check: Declaration | None = None


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoads:
    """What a model is worth under every load of a run.

    Attributes:
        name: Of the model, for people.
        protocol: `honest`, or how its fit departs from that.
        loads: The first one, under which it was fitted, then the others.
    """

    name: str
    protocol: str
    loads: tuple[Scored, ...]

    def worst(self) -> tuple[Scored, float]:
        """The load told of which it errs most, and by how many times as much as with the first.

        Both errors are means over the joints; NaN where one is not known.
        """
        bare, *others = (mean_of(one.errors["declared"]) for one in self.loads)
        ratios = np.array(others) / bare
        i = int(np.argmax(ratios))  # a NaN counts as the largest
        return self.loads[1 + i], float(ratios[i])

    def contradicted(self) -> tuple[str, ...]:
        """Loads whose declaration is contradicted, or could not be checked."""
        others = (one for one in self.loads if one.case.told is not None)
        return tuple(one.case.name for one in others if one.check is None or not one.check.agrees)


def checked(loads: Sequence[Scored], false_alarm: float) -> tuple[Scored, ...]:
    """With every declaration judged, gains told by the other loads."""
    known = [one for one in loads if one.estimate is not None]
    declared = [one.case.declared for one in known]
    estimates = [one.estimate for one in known if one.estimate is not None]
    checks = iter(check_declarations(declared, estimates, false_alarm=false_alarm))
    return tuple(one if one.estimate is None else replace(one, check=next(checks)) for one in loads)


def scored(
    model: RobotEstimator,
    case: LoadCase,
    scale: FloatArray,
    friction: Friction | Literal["auto"] = "auto",
) -> Scored:
    """A load's errors; an estimate that fails is told, not raised.

    Args:
        model: Fitted without it.
        case: The load.
        scale: (n,) torque per unit of effort.
        friction: See `estimate_payload`.
    """
    loads = {"unaware": Payload(), "declared": case.declared}
    found, failed = None, ""
    if case.told is not None:
        try:
            found = estimate_payload(model, case.told, friction=friction)
            loads["identified"] = found.payload
        except FitError as error:
            failed = error.message
    errors = {told: _error(model, case.judged, load, scale) for told, load in loads.items()}
    return Scored(case, errors, found, failed)


def _error(model: RobotEstimator, data: Dataset, load: Payload, scale: FloatArray) -> FloatArray:
    predicted = model.predict(with_identified(data, load))
    torque = np.where(predicted.valid, predicted.effort, np.nan) * scale
    return rmse_where(data["effort_f"] * scale, torque, np.isfinite(torque))
