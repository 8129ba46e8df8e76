"""Before anything moves: is this the arm the station means, and does it let itself be moved?"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import RobotConnectionError, RobotFault
from hil_drivers.ur.dashboard import Dashboard
from hil_drivers.ur.faults import complaints, occupied, remedies, speed_complaint
from hil_drivers.ur.options import SERIES_HZ

LEAST = {3: (3, 11), 5: (5, 6)}
"""Oldest software of a generation that tells the payload it believes in."""


@dataclass(frozen=True, slots=True)
class Told:
    """What the dashboard told, empty where it could not be asked.

    Attributes:
        polyscope: Version of the controller's software.
        serial: Of the arm.
        model: Such as `UR5`.
        remote: `true`, `false`, or empty on controllers without that distinction.
    """

    polyscope: str = ""
    serial: str = ""
    model: str = ""
    remote: str = ""


def told_by_dashboard(address: str) -> Told:
    """Ask what RTDE does not tell.

    Raises:
        RobotConnectionError: There is no dashboard server.
    """
    with Dashboard(address) as dashboard:
        return Told(
            polyscope=dashboard.ask("PolyscopeVersion"),
            serial=dashboard.ask("get serial number"),
            model=dashboard.ask("get robot model"),
            remote=dashboard.ask("is in remote control").lower(),
        )


def require_ready(
    address: str, model: str, told: Told, version: tuple[int, ...], row: np.void
) -> None:
    """Every reason at once why this arm cannot be moved.

    Args:
        address: Of the controller.
        model: The arm of the station.
        told: By the dashboard.
        version: Of the controller, by RTDE.
        row: The newest raw row.

    Raises:
        RobotConnectionError: It is another arm, or its software is too old.
        RobotFault: It is not in a state in which it may move.
    """
    if wrong := [*_wrong_arm(model, told, version), *_too_old(version)]:
        raise _error(RobotConnectionError, address, wrong)
    # `ur-rtde` would end whatever program there is, or wait for its end for minutes.
    not_ready = [*complaints(row), *occupied(row), *speed_complaint(row)]
    if "false" in told.remote:
        not_ready.append(
            ("the arm is in local control", "switch it to remote control at the teach pendant")
        )
    if not_ready:
        raise _error(RobotFault, address, not_ready)


def require_arm(address: str, model: str, told: Told, version: tuple[int, ...]) -> None:
    """Refuse an arm that is not the station's: its samples would be fitted to another model.

    Args:
        address: Of the controller.
        model: The arm of the station.
        told: By the dashboard.
        version: Of the controller, by RTDE.

    Raises:
        RobotConnectionError: It is another arm.
    """
    if wrong := _wrong_arm(model, told, version):
        raise _error(RobotConnectionError, address, wrong)


def _wrong_arm(model: str, told: Told, version: tuple[int, ...]) -> list[tuple[str, str]]:
    wrong = []
    if SERIES_HZ[model] != (125 if version[0] <= 3 else 500):
        series = "CB3" if version[0] <= 3 else "e-Series"
        wrong.append((f"it is a {series} controller, a {model} has another one", _STATION))
    size, said = re.sub(r"\D", "", model), re.sub(r"\D", "", told.model)
    if said and said != size:
        wrong.append((f"it moves a {told.model}, the station says {model}", _STATION))
    return wrong


def _too_old(version: tuple[int, ...]) -> list[tuple[str, str]]:
    least = LEAST.get(version[0])
    if least is not None and tuple(version[:2]) < least:
        said = ".".join(map(str, version[:3]))
        return [(f"its software {said} does not tell the payload", f"update it to {least[0]}."
                 f"{least[1]} or later")]  # fmt: skip
    if least is None:
        return [(f"software {version[0]}.x is not supported", "CB3 3.x and e-Series 5.x are")]
    return []


def _error(kind: Any, address: str, reasons: list[tuple[str, str]]) -> Any:
    return kind(
        f"{address}: {'; '.join(what for what, _ in reasons)}",
        hint=remedies(reasons),
    )


_STATION = "see address and model in the station file"
