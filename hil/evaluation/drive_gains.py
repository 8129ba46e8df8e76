"""Drive gains of recordings: sources in, gains out; `hil.estimators` sees datasets only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from hil.core import DataError, SpecError, did_you_mean
from hil.data import Dataset, SeriesKind
from hil.dynamics import load_model
from hil.estimators import (
    ControllerGains,
    Gains,
    calibrate_gains,
    controller_gains,
    shows_controller,
)
from hil.importers import load_source

GainsMethod = Literal["auto", "known-loads", "controller"]


def gains_of_sources(
    sources: Sequence[Path], robot: str | None = None, method: GainsMethod = "auto"
) -> Gains | ControllerGains:
    """Drive gains from runs or files.

    Args:
        sources: One run with several known loads, or one source per load; or recordings of motion
            in which the controller's currents and torques were logged.
        robot: Built-in arm or URDF; by default what the data says.
        method: `known-loads` needs dwells, `controller` needs `torque_target`; `auto` takes the
            first where there are dwells under several loads, else the second where it can.

    Raises:
        DataError: A source cannot be read, or they are of different robots.
        FitError: They do not tell the gains, see `calibrate_gains` and `controller_gains`.
        SpecError: There is no such method.
    """
    if method not in get_args(GainsMethod):
        raise SpecError(
            f"there is no way {method!r} to find drive gains",
            hint=did_you_mean(method, get_args(GainsMethod)),
        )
    if not sources:
        raise DataError("no recording was given", hint="hil gains RUN")
    kinds: tuple[SeriesKind, ...] = ("dwell", "trajectory")
    named = robot is not None
    parts = [load_source(source, kinds=kinds, any_arm=named) for source in sources]
    data = Dataset.concatenate(parts)
    if method == "controller" or (method == "auto" and _only_controller(data)):
        return controller_gains(data)
    return calibrate_gains(data, load_model(robot or data.robot, gravity=data.gravity))


def _only_controller(data: Dataset) -> bool:
    """Whether the controller's log tells gains and known loads do not."""
    loads = {condition.payload for condition in data.of_kind("dwell").conditions}
    return len(loads) < 2 and shows_controller(data)
