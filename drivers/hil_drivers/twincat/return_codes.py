"""What ADS return codes and states mean for whoever stands at the bench."""

from __future__ import annotations

from typing import Any

from hil.core import (
    CommandRefused,
    HilError,
    PluginError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
)

RUN = 5
STATES = {2: "RESET", 3: "INIT", 4: "START", 5: "RUN", 6: "STOP", 11: "ERROR", 15: "CONFIG"}
"""ADS states of a runtime."""

NO_RUNTIME, NO_ROUTE = 6, 7
BUSY, NO_SYMBOL, OTHER_VERSION, WRONG_STATE, DEVICE_TIMED_OUT = 0x708, 0x710, 0x711, 0x712, 0x719
TIMED_OUT = (0x745, 0x274C)
DEVICE_CODES = range(0x700, 0x740)
"""Answers of the PLC itself; all others come from the way to it."""

ROUTE = (
    "add a route to this computer on the PLC (TwinCAT: System, Routes), and see that ams_net_id "
    "is the PLC's"
)
LOST = "see to cable and PLC, then connect again"
AGAIN = "connect again"
ASKED = "asked for "


def error_of(
    error: Exception, where: str, what: str, *, timeout_s: float, answered: bool
) -> HilError:
    """The error that tells what went wrong with a request.

    Args:
        error: Of `pyads`.
        where: Which PLC.
        what: Was asked for.
        timeout_s: How long was waited [s].
        answered: Whether this PLC has ever answered: a missing route is no reason then.
    """
    code = getattr(error, "err_code", None)
    if code in TIMED_OUT:
        return RobotTimeout(
            f"{where} has not answered within {timeout_s:g} s: {what}",
            hint=LOST if answered else ROUTE,
        )
    if isinstance(code, int) and (code in DEVICE_CODES or code in (NO_RUNTIME, NO_ROUTE)):
        return error_of_code(code, where, what, text_of(error))
    return RobotConnectionError(
        f"{where}: the connection is lost: {what}: {text_of(error)}", hint=LOST
    )


def error_of_code(code: int, where: str, what: str, said: str = "") -> HilError:
    """The error for a return code that a PLC, or the router before it, has given.

    Args:
        code: Not 0.
        where: Which PLC.
        what: Was asked for.
        said: What the library says about it.
    """
    if code == NO_SYMBOL and what.startswith(ASKED):
        return PluginError(
            f"{where} has no variable {what.removeprefix(ASKED)}",
            hint="download the PLC program that docs/how-to/drive-twincat.md describes, or mend "
            "the option prefix",
        )
    if code in (NO_SYMBOL, OTHER_VERSION):
        return changed_online(where)
    if code in (BUSY, DEVICE_TIMED_OUT):
        why = "is busy" if code == BUSY else "has timed out in itself"
        return RobotTimeout(f"{where} {why}: {what}", hint="see to TwinCAT's load, then try again")
    if code == NO_RUNTIME:
        return RobotConnectionError(
            f"{where}: no PLC runtime answers there: {what}",
            hint="bring TwinCAT into run mode, log in, start the PLC; is port its runtime's?",
        )
    if code == WRONG_STATE:
        return RobotConnectionError(
            f"{where}: its runtime is in a state in which it answers nothing: {what}",
            hint="bring TwinCAT into run mode and start the PLC",
        )
    if code == NO_ROUTE:
        return RobotConnectionError(f"{where}: there is no route to it: {what}", hint=ROUTE)
    return CommandRefused(
        f"{where}: {what}: {said or f'ADS return code {code:#x}'}", hint="see the PLC's log"
    )


def changed_online(where: str) -> RobotFault:
    """The error for a program whose variables are no longer where they were found."""
    return RobotFault(
        f"{where}: its program was changed online: variables lie elsewhere now; the heartbeat has "
        "ended, so that the PLC's watchdog brings the arm to rest",
        hint=AGAIN,
    )


def text_of(error: Any) -> str:
    """What the library says about it."""
    return str(getattr(error, "msg", None) or error).strip().rstrip(".")
