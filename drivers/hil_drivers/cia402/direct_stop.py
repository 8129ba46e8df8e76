"""Stopping all axes without the process that drives them: quick stop, sent by anybody on the bus.

A drive that has got one quick stop brakes and switches itself off (605Ah = 2); set-points that
another master still sends do not take it back.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing

from hil.can import pack_frame
from hil.core import HilError
from hil_drivers.cia402.contracts import Outputs
from hil_drivers.cia402.mapping import MAPPINGS, SYNC_COB_ID
from hil_drivers.cia402.objects import MODE_NAMES
from hil_drivers.cia402.opening import open_bus
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.pdo_frames import Commands
from hil_drivers.cia402.ports import FramePort, port_of
from hil_drivers.cia402.states import QUICK_STOP

TIMES, APART_S = 3, 0.002
"""How often quick stop is sent, and how far apart [s]: a frame may be lost, a queue full for a
moment, and who commands at the same time is overruled."""

MODES = {name: code for code, name in MODE_NAMES.items()}


def stop_directly(options: Options) -> bool:
    """Tell every drive to stop; from any thread, without a lock, within milliseconds.

    Args:
        options: Of the arm: its bus and nodes, and what its process data look like.

    Returns:
        Whether it is on the bus, at least once as a whole. An adapter that only one program can
        open is still taken while the process that drives the arm lives.
    """
    try:
        with closing(_Bus(options)) as bus:
            sent = [_sent(bus.port, options, k > 0) for k in range(TIMES)]
            return any(sent)
    except HilError:
        return False


def quick_stop_frames(options: Options) -> Iterator[bytes | memoryview]:
    """The commands of all axes, and the SYNC with which they are applied."""
    outputs = Outputs.idle(len(options.nodes))
    outputs.controlword[:] = [QUICK_STOP] * len(options.nodes)
    outputs.mode[:] = [MODES[options.trajectory_mode]] * len(options.nodes)
    commands = Commands(MAPPINGS[options.mapping], options.nodes)
    commands.pack(outputs)
    yield from commands.frames[: len(options.nodes)]  # RPDO 1 has the controlword
    yield pack_frame(SYNC_COB_ID, b"")


def _sent(port: FramePort, options: Options, again: bool) -> bool:
    """Whether there was room for all of it; a little later when it is sent again."""
    if again:
        time.sleep(APART_S)
    sent = [port.send(frame) for frame in quick_stop_frames(options)]
    return all(sent)


class _Bus:
    def __init__(self, options: Options) -> None:
        self._bus = open_bus(options.bus, within_s=0.0)
        self.port: FramePort = port_of(self._bus)

    def close(self) -> None:
        self._bus.shutdown()
