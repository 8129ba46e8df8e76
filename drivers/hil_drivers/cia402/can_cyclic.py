"""One cycle over CAN: SYNC, an RPDO or two per axis, the TPDOs that answer it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hil_drivers.cia402.contracts import Inputs, News, Outputs
from hil_drivers.cia402.mapping import Mapping


class CanCyclic:
    """Implements `hil_drivers.cia402.contracts.Cyclic` over a frame port.

    Args:
        port: Sends and receives 16-byte frames (`hil_drivers.cia402.ports`).
        mapping: Of every axis.
        nodes: Node ids, in the order of the axes.
        period_s: Device time of a cycle [s].
        master_id: Of our heartbeat and marker.
        notify: Gets every frame that is no process data: `canopen.Network.notify`
            (COB-ID, data, Unix time); called by the thread that calls us.
        log: Gets every frame sent and received: Unix time, 16 bytes.

    Attributes:
        counts: What has gone wrong so far.
        sync_time: Unix time of the last SYNC.
        sent: (R, n, 8) RPDO bytes sent with it, as they lie in memory until the next exchange.
        answered: (T, n, 8) TPDO bytes, likewise.
    """

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """See `Cyclic`."""

    def pump(self, until_s: float) -> None:
        """See `Cyclic`; also sends the master's heartbeat."""

    def news(self) -> News:
        """See `Cyclic`."""

    def watch(self, on: bool) -> None:
        """Whether overdue heartbeats and boot-ups of the drives are news, from now on."""
