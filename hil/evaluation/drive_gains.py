"""Identification of drive gains from recordings on disk.

The methods for drive gains are in `hil.estimators` and use datasets only.
"""

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
    """Return the drive gains identified from runs or files.

    Args:
        sources: One run with several known payloads, one source per payload, or recordings of
            motion with the currents and torques of the controller.
        robot: Built-in arm or URDF; None for the robot that the data declare.
        method: The method `known-loads` needs dwells, the method `controller` needs
            `torque_target`. The value `auto` chooses `known-loads` for dwells with several
            payloads, and otherwise `controller` if possible.

    Raises:
        DataError: A source cannot be read, or the sources are recordings of different robots.
        FitError: The data do not determine the gains, see `calibrate_gains` and `controller_gains`.
        SpecError: The name of the method is unknown.
    """
    if method not in get_args(GainsMethod):
        raise SpecError(
            f"unknown method {method!r}",
            hint=did_you_mean(method, get_args(GainsMethod)),
        )
    if not sources:
        raise DataError("no recording was given", hint="hil drive-gains RUN")
    kinds: tuple[SeriesKind, ...] = ("dwell", "trajectory")
    named = robot is not None
    parts = [load_source(source, kinds=kinds, any_arm=named) for source in sources]
    data = Dataset.concatenate(parts)
    if method == "controller" or (method == "auto" and _only_controller(data)):
        return controller_gains(data)
    return calibrate_gains(data, load_model(robot or data.robot, gravity=data.gravity))


def _only_controller(data: Dataset) -> bool:
    """Return whether only the method `controller` can determine the drive gains."""
    loads = {condition.payload for condition in data.of_kind("dwell").conditions}
    return len(loads) < 2 and shows_controller(data)
