"""One end of the bus with all that goes over it: frames, objects, cycles, and a log of it all."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence

from hil.can import pack_frame
from hil.core import HilError, RobotConnectionError
from hil_drivers.cia402.bus_log import BusLog
from hil_drivers.cia402.can_cyclic import CanCyclic, LoggedPort
from hil_drivers.cia402.canopen_acyclic import CanopenAcyclic
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.masters import LISTEN_INSIDE_S, LISTEN_S, require_no_master
from hil_drivers.cia402.opening import open_bus
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.ports import port_of
from hil_drivers.cia402.temperatures import Temperatures

ROOM_S = 0.5
"""How long room in the transmit queue is waited for by what is no process data [s]."""

LOOK_S = 0.002


class Joined:
    """The bus, joined; nothing is asked of any drive yet.

    Args:
        options: Of the station.
        names: Of the axes, for messages.

    Attributes:
        acyclic: Objects of the drives; answered while somebody pumps or cycles go on.
        cyclic: Their process data.
        temperatures: Heard from their answers.

    Raises:
        RobotConnectionError: There is no such bus, its adapter is not there, or another master is
            on it.
        PluginError: A package is missing.
        RecordingError: The log of the bus cannot be made.
        SpecError: An EDS file cannot be read.
    """

    def __init__(self, options: Options, names: Sequence[str]) -> None:
        self._leaving = contextlib.ExitStack()
        self._log: BusLog | None = None
        try:
            self._join(options, names)
        except BaseException:
            self.leave()
            raise

    def flush(self) -> None:
        """Write what the log of the bus has kept."""
        if self._log is not None:
            self._log.flush()

    def leave(self) -> None:
        """Leave the bus; never raises."""
        with contextlib.suppress(HilError):
            self._leaving.close()

    def _join(self, options: Options, names: Sequence[str]) -> None:
        bus = open_bus(options.bus)
        self._leaving.callback(bus.shutdown)
        if options.candump:
            self._log = BusLog(options.candump, options.bus.channel)
            self._leaving.callback(self._log.close)
        self._port = port_of(bus)
        self._listen(options)
        self.temperatures = Temperatures(options.nodes, options.temperature_object)
        self.acyclic = CanopenAcyclic(self._send, options.nodes, names, options.eds)
        self.cyclic = CanCyclic(
            self._port,
            MAPPINGS[options.mapping],
            options.nodes,
            options.period_s,
            master_id=options.master_id,
            notify=self._heard,
            log=self._log,
            late_cycles=options.late_cycles,
        )

    def _listen(self, options: Options) -> None:
        """Nobody else may drive these axes; before anything is sent."""
        port = self._port if self._log is None else LoggedPort(self._port, self._log)
        inside = options.bus.interface == "virtual"
        lasts_s = LISTEN_INSIDE_S if inside else LISTEN_S
        require_no_master(port, options.nodes, options.master_id, lasts_s)

    def _heard(self, can_id: int, data: bytes, time_s: float) -> None:
        """What is no process data; by the thread that owns the bus."""
        self.temperatures.heard(can_id, data)
        self.acyclic.heard(can_id, data, time_s)

    def _send(self, can_id: int, data: bytes) -> None:
        """For what is no process data; waits for room."""
        frame, until = pack_frame(can_id, data), time.monotonic() + ROOM_S
        while not self._port.send(frame):
            if time.monotonic() > until:
                raise RobotConnectionError(
                    f"the bus has had no room for a frame for {ROOM_S:g} s",
                    hint="see to cable, termination and bit rate: does any drive acknowledge?",
                )
            time.sleep(LOOK_S)
        if self._log is not None:
            self._log(time.time(), frame)
