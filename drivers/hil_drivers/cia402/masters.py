"""Frames that only a master sends: whoever sends them beside us drives the same arm."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from hil.can import FRAME
from hil.core import RobotConnectionError
from hil_drivers.cia402.mapping import RPDO_COB_IDS, SYNC_COB_ID, rpdo_cob_id
from hil_drivers.cia402.ports import FramePort
from hil_drivers.cia402.states import QUICK_STOP

LISTEN_S = 0.3
"""Wall time for which the bus is listened to before anything is sent [s]."""

LISTEN_INSIDE_S = 0.03
"""The same on a bus that reaches no other process [s]."""

ALLOWED_S = 0.05
"""Wall time for which the SYNC of somebody's quick stop may come [s]."""

HEARTBEAT_COB_ID = 0x700
ANOTHER = "another master is on the bus"
HINT = "end it first: another hil, a PLC, a drive maker's tool, a drive that produces SYNC (1005h)"


def commanding(nodes: Sequence[int]) -> dict[int, str]:
    """COB-ID of SYNC and of all commands to these nodes → how to call it."""
    names = {SYNC_COB_ID: f"SYNC ({SYNC_COB_ID:03X}h)"}
    for number in range(1, len(RPDO_COB_IDS) + 1):
        for node in nodes:
            can_id = rpdo_cob_id(number, node)
            names[can_id] = f"RPDO{number} of node {node} ({can_id:03X}h)"
    return names


def require_no_master(
    port: FramePort, nodes: Sequence[int], master_id: int, lasts_s: float = LISTEN_S
) -> None:
    """Listen, and send nothing.

    Args:
        port: To the bus.
        nodes: Of our drives.
        master_id: Of our heartbeat.
        lasts_s: Wall time [s].

    Raises:
        RobotConnectionError: Somebody else commands these drives, or uses our node id.
    """
    beat = HEARTBEAT_COB_ID + master_id
    names = commanding(nodes) | {beat: f"the heartbeat of node {master_id}, our own ({beat:03X}h)"}
    heard: dict[str, int] = {}
    until_s = time.monotonic() + lasts_s
    while time.monotonic() < until_s:
        raw = port.receive(until_s)
        if raw is not None and (name := names.get(FRAME.unpack(raw)[0])):
            heard[name] = heard.get(name, 0) + 1
    if heard:
        told = ", ".join(f"{number} × {name}" for name, number in heard.items())
        raise RobotConnectionError(f"{ANOTHER}: {told} within {lasts_s:g} s", hint=HINT)


class MasterWatch:
    """Tells what another master sends while we drive the arm.

    Whoever stops the arm from outside (`direct_stop`) sends quick stops and a SYNC; that is no
    second master, and the axes themselves tell that they stop.

    Args:
        nodes: Of our drives.
    """

    def __init__(self, nodes: Sequence[int]) -> None:
        self._names: Mapping[int, str] = commanding(nodes)
        self._allowed_until_s = 0.0

    def heard(self, can_id: int, data: bytes) -> str:
        """What is wrong with a frame that we did not send; empty when nothing is."""
        name = self._names.get(can_id)
        if name is None:
            return ""
        now = time.monotonic()
        if can_id != SYNC_COB_ID and int.from_bytes(data[:2], "little") == QUICK_STOP:
            self._allowed_until_s = now + ALLOWED_S
            return ""
        if can_id == SYNC_COB_ID and now < self._allowed_until_s:
            return ""
        return f"{ANOTHER}: {name} was not sent by us"
