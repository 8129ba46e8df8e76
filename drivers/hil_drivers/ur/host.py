"""Where a controller is: its name becomes an address once, when it is connected to."""

from __future__ import annotations

import ipaddress
import socket
import threading

from hil.core import RobotConnectionError

WITHIN_S = 5.0
"""How long a name server may take [s]."""


def found(address: str, within_s: float = WITHIN_S) -> str:
    """The IP address of a controller; nothing is asked for one that is written as such.

    Args:
        address: IP address or host name.
        within_s: Wall time this may take. A name server that hangs keeps a thread, nobody else.

    Raises:
        RobotConnectionError: Nobody knows the name, or nobody has answered in time.
    """
    try:
        return str(ipaddress.ip_address(address))
    except ValueError:
        pass
    answers: list[str | OSError] = []
    asking = threading.Thread(
        target=_ask, args=(address, answers), name=f"find {address}", daemon=True
    )
    asking.start()
    asking.join(within_s)
    answer = answers[0] if answers else f"no answer within {within_s:g} s"
    if answers and isinstance(answer, str):
        return answer
    why = (answer.strerror or answer) if isinstance(answer, OSError) else answer
    raise RobotConnectionError(
        f"the controller's host name {address!r} leads to no address: {why}",
        hint=f"mend the name in the station file (`ping {address}` shows whether it is one), or "
        "give the IP address there that the controller's network settings show",
    )


def _ask(address: str, answers: list[str | OSError]) -> None:
    try:
        # UR controllers and `ur-rtde` speak IPv4.
        told = socket.getaddrinfo(address, None, socket.AF_INET, socket.SOCK_STREAM)
        answers.append(str(told[0][4][0]))
    except OSError as error:
        answers.append(error)
