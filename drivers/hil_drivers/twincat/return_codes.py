"""What ADS return codes and states mean for whoever stands at the bench."""

from __future__ import annotations

from typing import Any

from hil.errors import CommandRefused, HilError, PluginError, RobotConnectionError, RobotTimeout

RUN = 5
STATES = {2: "RESET", 3: "INIT", 4: "START", 5: "RUN", 6: "STOP", 11: "ERROR", 15: "CONFIG"}
"""ADS states of a runtime."""

NO_RUNTIME, NO_SYMBOL, TIMED_OUT = (6, 7), (0x710,), (0x745, 0x274C)
DEVICE_CODES = range(0x700, 0x740)
"""Answers of the PLC itself; all others come from the way to it."""

ROUTE = (
    "add a route to this computer on the PLC (TwinCAT: System, Routes), and see that ams_net_id "
    "is the PLC's"
)
LOST = "see to cable and PLC, then connect again"


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
    if code in NO_SYMBOL:
        return PluginError(
            f"{where} has no variable {what.removeprefix('asked for ')}",
            hint="download the PLC program that docs/how-to/drive-twincat.md describes, or mend "
            "the option prefix",
        )
    if code in TIMED_OUT:
        return RobotTimeout(
            f"{where} has not answered within {timeout_s:g} s: {what}",
            hint=LOST if answered else ROUTE,
        )
    if code in NO_RUNTIME:
        return RobotConnectionError(
            f"{where}: no PLC runtime answers there: {what}",
            hint="bring TwinCAT into run mode, log in, start the PLC; is port its runtime's?",
        )
    if code in DEVICE_CODES:
        return CommandRefused(f"{where}: {what}: {text_of(error)}", hint="see the PLC's log")
    return RobotConnectionError(
        f"{where}: the connection is lost: {what}: {text_of(error)}", hint=LOST
    )


def text_of(error: Any) -> str:
    """What the library says about it."""
    return str(getattr(error, "msg", None) or error).strip().rstrip(".")
