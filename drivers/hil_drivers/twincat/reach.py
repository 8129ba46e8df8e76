"""What has to be there before a line is opened: the library, and somebody who listens."""

from __future__ import annotations

from typing import Any

from hil.core import PluginError, RobotConnectionError
from hil.robot import Finding
from hil_drivers.network import is_ip, once_listening, peer_of, reason
from hil_drivers.twincat.options import Options

REACHED_WITHIN_S = 3.0
"""How long a TCP connection may take: the library itself waits for minutes [s]."""


def address_of(options: Options) -> str:
    """What the library connects to, once it is sure that somebody listens.

    Once, before anything is open: a PLC may let go of an older connection from this computer.
    A mock that is still starting on this computer is waited for.

    Raises:
        RobotConnectionError: Nobody does.
    """
    host, _ = options.host
    if not is_ip(host):
        return _found(options)
    return once_listening(host, lambda: _found(options))


def _found(options: Options) -> str:
    host, port = options.host
    try:
        found = peer_of(host, port, REACHED_WITHIN_S)
    except OSError as error:
        raise RobotConnectionError(
            f"PLC {options.address}: nobody listens on port {port}: {reason(error)}",
            hint="is it on, and is it this address? TwinCAT's ADS port 48898 must be open in its "
            "firewall; the mock is started with: hil mock plc",
        ) from error
    return f"{found}:{port}"


def reached(options: Options) -> list[Finding]:
    """Whether somebody listens at the address, asked once: no ADS is spoken, nothing is taken."""
    try:
        return [Finding("port", True, f"a PLC's ADS port answers at {_found(options)}")]
    except RobotConnectionError as error:
        return [Finding("port", False, error.message, hint=error.hint)]


def library() -> Any:
    """`pyads`.

    Raises:
        PluginError: It is not installed, or cannot be used here.
    """
    try:
        import pyads
    except (ImportError, OSError) as error:
        raise PluginError(
            f"the driver twincat needs pyads: {error}", hint='pip install "hil[ads]"'
        ) from error
    return pyads
