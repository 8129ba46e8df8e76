"""The core against six drives behind a real hub, in real time."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from hil.can.frames import Frame
from hil.can.hub import HostedHub, Hub, hub_thread
from hil_drivers.cia402.bus import Outputs
from hil_drivers.cia402.can_channel import port_of
from hil_drivers.cia402.can_cycle import CanCyclic
from hil_drivers.cia402.core import Core
from hil_drivers.cia402.mapping import POSITION
from hil_drivers.cia402.player import Player
from hil_drivers.cia402.rows import INCOMPLETE
from hil_drivers.cia402.supervisor import Phase, Supervisor
from hil_drivers.cia402.timing import Schedule
from hil_drivers.cia402.track import Track
from tests.support.cia402_parts import CSP, ENABLED, FakeDrive

pytestmark = pytest.mark.wire

N = 6
RATE_HZ = 100.0
NODES = tuple(range(1, N + 1))


class Nodes:
    """Six drives as the host of a bus has them: RPDOs kept until the next SYNC, TPDOs at it."""

    def __init__(self, hub: Hub) -> None:
        self._send = hub.local.send
        self.drives = {node: FakeDrive(1000 * node) for node in NODES}
        self._told = dict.fromkeys(NODES, (0, 0, 0))
        self.mute: set[int] = set()
        self.targets: list[int] = []
        hub.local.heard = self.heard

    def heard(self, frame: Frame) -> None:
        if frame.id == 0x080:
            self._synced()
        elif frame.id & ~0x7F == 0x200:
            self._told[frame.id & 0x7F] = struct.unpack("<Hbi", frame.data)

    def _synced(self) -> None:
        for node, drive in self.drives.items():
            word, mode, target = self._told[node]
            drive.apply(word, mode)
            if drive.status == ENABLED:
                drive.position = target
            if node in self.mute:
                continue
            self._send(0x180 + node, struct.pack("<Hib", drive.status, drive.position, drive.mode))
            self._send(0x280 + node, bytes(8))
            if len(self.targets) % 10 == 0:
                self._send(0x700 + node, b"\x05")
        self.targets.append(self._told[1][2])


class Bench:
    """The core on one end of a bus, drives on the other."""

    def __init__(self, hosted: HostedHub, bus: can.BusABC) -> None:
        self.hosted = hosted
        self.made: list[Nodes] = []
        hosted.ask(lambda hub: self.made.append(Nodes(hub)))
        self.nodes = self.made[0]
        period_s, outputs = 1.0 / RATE_HZ, Outputs.idle(N)
        self.cyclic = CanCyclic(port_of(bus), POSITION, NODES, period_s)
        self.supervisor = Supervisor(NODES, period_s, outputs, late_cycles=20)
        self.player = Player(period_s, [1e-6] * N)
        self.core = Core(
            self.cyclic,
            self.supervisor,
            self.player,
            outputs,
            Schedule(period_s),
            POSITION,
            period_s=period_s,
            wall_period_s=period_s,
        )
        self.core.open()
        self.core.run()
        self.core.enable(CSP)

    def problem(self, within_s: float = 5.0) -> str:
        until = time.monotonic() + within_s
        while not (problem := self.core.take_problem()):
            assert time.monotonic() < until
            time.sleep(0.005)
        return problem


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    channel = str(tmp_path / "bus.sock")
    with hub_thread(channel) as hosted, can.Bus(interface="hil_unix", channel=channel) as bus:
        bench = Bench(hosted, bus)
        try:
            yield bench
        finally:
            bench.core.close()


def test_motion_is_followed_and_every_cycle_recorded(bench: Bench) -> None:
    position = 1000 * np.arange(1, N + 1) + 50 * np.arange(60)[:, None]
    zeros = np.zeros_like(position)
    bench.core.prepare(Track(3, position, zeros, zeros, zeros))
    bench.core.start()
    until = time.monotonic() + 10.0
    while bench.player.moving:
        assert time.monotonic() < until
        time.sleep(0.005)
    over = bench.cyclic.cycle + 5  # until its last set-point is reached, and told
    while bench.cyclic.cycle < over:
        assert time.monotonic() < until
        time.sleep(0.005)
    rows = bench.core.take(1.0)
    assert (np.diff(rows["cycle"]) == 1).all()
    measured = rows["tpdo"][:, 0, 0, 2:6].copy().view("<i4")[:, 0]
    assert measured[rows["flags"] & INCOMPLETE == 0][-1] == position[-1, 0]


def test_cycles_keep_their_rate(bench: Bench) -> None:
    first, begin = bench.cyclic.cycle, time.monotonic()
    time.sleep(1.0)
    rate_hz = (bench.cyclic.cycle - first) / (time.monotonic() - begin)
    assert rate_hz == pytest.approx(RATE_HZ, rel=0.1)


def test_drive_that_falls_silent_stops_all_others(bench: Bench) -> None:
    bench.hosted.ask(lambda hub: bench.nodes.mute.add(2))
    problem = bench.problem()
    assert "axis 2 (node 2): has not answered" in problem
    assert bench.nodes.drives[1].status != ENABLED


def test_bus_off_of_our_controller_is_told(bench: Bench) -> None:
    bench.hosted.ask(lambda hub: hub.bus_off())
    assert "bus-off" in bench.problem()
    assert bench.core.phase in (Phase.BRAKING, Phase.OFF)
