"""Is there an arm at that address, and would it let itself be moved? Asked from afar."""

from __future__ import annotations

from collections.abc import Iterator

from hil.core import RobotConnectionError
from hil.robot import Finding
from hil_drivers.network import peer_of, reason
from hil_drivers.ur.configuration import PRIMARY_PORT
from hil_drivers.ur.dashboard import PORT, Dashboard
from hil_drivers.ur.receiver import RTDE_PORT

PORTS = {PORT: "dashboard", PRIMARY_PORT: "primary interface", RTDE_PORT: "RTDE"}
WITHIN_S = 2.0
MAY_MOVE = "RUNNING"


def reached(address: str, within_s: float = WITHIN_S) -> Iterator[Finding]:
    """Ports first; then what the dashboard says. No program is uploaded, nothing is switched.

    Args:
        address: Of the controller.
        within_s: How long a connection, and each answer, may take [s].
    """
    silent = {port: why for port in PORTS if (why := _silence(address, port, within_s))}
    if silent:
        told = ", ".join(f"{port} ({PORTS[port]}): {why}" for port, why in silent.items())
        hint = "is the controller on, the address right, and are its services enabled?"
        yield Finding("ports", False, f"{address} does not answer on {told}", hint=hint)
    else:
        open_ = ", ".join(f"{port} ({name})" for port, name in PORTS.items())
        yield Finding("ports", True, f"{address} answers on {open_}")
    if PORT in silent:
        return
    try:
        with Dashboard(address, within_s) as dashboard:
            mode = _last_word(dashboard.ask("robotmode"))
            safety = _last_word(dashboard.ask("safetymode"))
            remote = dashboard.ask("is in remote control").lower()
    except RobotConnectionError as error:
        yield Finding("dashboard", False, error.message, hint=error.hint)
        return
    hint = "switch it on and release its brakes at the teach pendant"
    yield Finding("mode", mode == MAY_MOVE, f"robot mode {mode or 'not told'}", hint=hint)
    hint = "see the teach pendant for what has stopped it"
    normal = safety in ("NORMAL", "REDUCED")
    yield Finding("safety", normal, f"safety mode {safety or 'not told'}", hint=hint)
    if remote:
        away = "true" in remote
        hint = "switch it to remote control at the teach pendant"
        control = "remote" if away else "local"
        yield Finding("control", away, f"in {control} control", hint=hint)


def _silence(address: str, port: int, within_s: float) -> str:
    """Return why a port does not answer; empty if it does."""
    try:
        peer_of(address, port, within_s)
    except OSError as error:
        return reason(error)
    return ""


def _last_word(answer: str) -> str:
    """`RUNNING` of `Robotmode: RUNNING`."""
    return answer.rpartition(":")[2].strip()
