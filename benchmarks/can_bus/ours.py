"""The driver's cyclic core as it runs in a run: exchange, supervisor, player, records taken.

`python -m benchmarks.can_bus.ours CHANNEL RATE_HZ SECONDS [ordinary]` prints its figures.
"""

from __future__ import annotations

import math
import threading
import time

import can
import numpy as np

from benchmarks.can_bus.drives import NODES
from benchmarks.can_bus.timing import SETTLE_S, Stretch, Times, swing, tell
from hil_drivers.cia402.bus import Inputs, Outputs
from hil_drivers.cia402.can_channel import FramePort, port_of
from hil_drivers.cia402.can_cycle import CanCyclic
from hil_drivers.cia402.core import Core
from hil_drivers.cia402.mapping import POSITION
from hil_drivers.cia402.objects import CSP
from hil_drivers.cia402.player import Player
from hil_drivers.cia402.supervisor import Supervisor
from hil_drivers.cia402.track import Track

RAD_PER_INCREMENT = 2.0 * math.pi / 2**20 / 100.0

PATIENCE = 1_000_000
"""Cycles that may lack answers: what a busy machine costs is counted, and nothing is at stake."""


class TimedCyclic(CanCyclic):
    """Tells how long its exchanges take.

    Args:
        port: To the bus.
        period_s: Of a cycle [s].
        times: Are told.
    """

    def __init__(self, port: FramePort, period_s: float, times: Times) -> None:
        super().__init__(port, POSITION, NODES, period_s)
        self._times = times

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """See `CanCyclic`."""
        inputs = super().exchange(outputs, give_up_s)
        self._times.answering.add(time.time() - self.sync_time)
        self._times.complete = all(inputs.fresh)
        return inputs


def measure(channel: str, rate_hz: float, seconds: float) -> dict[str, float]:
    """Play a motion; what it took."""
    with can.Bus(interface="hil_unix", channel=channel) as bus:
        times = Times(1.0 / rate_hz)
        core, player = _core(port_of(bus), rate_hz, times)
        core.open()
        core.run()
        core.enable(CSP)
        positions = swing(rate_hz, SETTLE_S + seconds + 1.0, len(NODES)) + player.position
        nothing = np.zeros_like(positions)
        core.prepare(Track(0, positions, nothing, nothing, nothing))
        taken: list[int] = []
        over = threading.Event()
        taker = threading.Thread(target=_take, args=(core, over, taken))
        taker.start()
        core.start()
        time.sleep(SETTLE_S)
        stretch, before = Stretch(times), sum(taken)
        time.sleep(seconds)
        figures = stretch.figures()
        assert player.moving, "what was measured is not the motion"
        figures |= {"records": float(sum(taken) - before), "fifo": float(not core.not_permitted)}
        over.set()
        taker.join()
        core.close()
    return figures


def _core(port: FramePort, rate_hz: float, times: Times) -> tuple[Core, Player]:
    period_s, outputs = 1.0 / rate_hz, Outputs.idle(len(NODES))
    cyclic = TimedCyclic(port, period_s, times)
    supervisor = Supervisor(NODES, period_s, outputs, late_cycles=PATIENCE)
    player = Player(period_s, [RAD_PER_INCREMENT] * len(NODES))
    core = Core(
        cyclic,
        supervisor,
        player,
        outputs,
        times,
        POSITION,
        period_s=period_s,
        wall_period_s=period_s,
    )
    return core, player


def _take(core: Core, over: threading.Event, taken: list[int]) -> None:
    while not over.is_set():
        taken.append(len(core.take(1.0)))


if __name__ == "__main__":
    tell(measure)
