"""Puts the parts of a mock together, from what was asked for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from hil.arms import Payload, load_arm
from hil_mock_robot.cia402.body import Body
from hil_mock_robot.cia402.bus import BusEnd
from hil_mock_robot.cia402.faults import CanFault, faults_of_station
from hil_mock_robot.cia402.loop import Loop
from hil_mock_robot.cia402.options import MASTER_ID, nodes_of, pose_of
from hil_mock_robot.cia402.side import Requests, SideChannel
from hil_mock_robot.cia402.station import PATIENCE_S, DeviceClock, MotionWatch, Station
from hil_mock_robot.cia402.witness import Witness
from hil_mock_robot.plant.truth import Truth
from hil_mock_robot.server.journal import Journal


class Mock:
    """Drives on a bus, with what goes wrong and who writes it down.

    Args:
        truth: What the arm is really like.
        end: Of the bus.
        nodes: Node id of each axis; 1, 2 … when empty.
        start_q_deg: Where the arm stands at first; zeros when empty.
        mounted: What really hangs at the flange; what is declared when None.
        master_id: Node id under which the master announces what it does.
        patience_s: Wall time without SYNC after which the drives go by their own timer.
        faults: What is to go wrong.
        journal: File for what happens.
        side: Socket of the side channel.

    Attributes:
        station, motions, faults, requests, loop: Its parts.

    Raises:
        SpecError: An option or a fault cannot be.
        RobotConnectionError: The journal cannot be written.
        PluginError: The side channel cannot listen.
    """

    def __init__(
        self,
        truth: Truth,
        end: BusEnd,
        *,
        nodes: Sequence[int] = (),
        start_q_deg: Sequence[float] = (),
        mounted: Payload | None = None,
        master_id: int = MASTER_ID,
        patience_s: float = PATIENCE_S,
        faults: Sequence[CanFault] = (),
        journal: Path | str | None = None,
        side: Path | str | None = None,
    ) -> None:
        body = Body(truth, pose_of(start_q_deg, load_arm(truth.arm)), mounted=mounted)
        clock = DeviceClock(time.monotonic(), patience_s)
        ids = nodes_of(nodes, body.arm, master_id)
        self.station = Station(body, ids, end.send, clock, master_id, mounted, end.flush)
        self.motions = MotionWatch(self.station)
        witness = self._witness(end, journal)
        self.faults = faults_of_station(self.station, end, faults)
        self.motions.listeners.append(self._moved)
        if witness is not None:
            self.faults.listeners.append(witness.struck)
        # The motion is counted before faults that wait for it are looked at, and before the
        # journal says how it ended.
        self.station.passed += [self.motions.passed, self.faults.passed]
        if witness is not None:
            self.station.passed.append(witness.passed)
        self.requests = Requests(self.station, self.faults)
        channel = None if side is None else SideChannel(side, self.requests)
        self.loop = Loop(end, self.station, channel, witness)

    def _moved(self, begins: bool) -> None:
        if begins:
            self.faults.began("motion")

    def _witness(self, end: BusEnd, path: Path | str | None) -> Witness | None:
        if path is None:
            return None
        journal = Journal(str(path), end.where)
        journal.open()
        return Witness(self.station, self.motions, journal)
