"""One cycle over CAN: SYNC, an RPDO or two per axis, the TPDOs that answer it.

docs/explanation/can-cycle.md says what is on the wire when, and what is counted as what.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence

from hil.can import pack_frame
from hil_drivers.cia402.bursts import sending
from hil_drivers.cia402.collecting import Collector
from hil_drivers.cia402.contracts import Inputs, News, Outputs
from hil_drivers.cia402.mapping import SYNC_COB_ID, Mapping, tpdo_cob_id
from hil_drivers.cia402.node_watch import HEARTBEAT_COB_ID, Counts, NodeWatch, Notify
from hil_drivers.cia402.pdo_frames import Answers, Commands
from hil_drivers.cia402.ports import FramePort

BEAT_S = 0.05
"""From one heartbeat of ours to the next, by device time [s]."""

PUMP_S = 0.01
"""How long one wait of `pump` takes at most [s]."""

SLACK_SHARE, MOST_SLACK_S = 0.5, 0.002
"""Share of the time for answers, and time [s], within which frames may wait for room."""

_OPERATIONAL = b"\x05"
MARKER = struct.Struct("<iH")
"""What the master announces: segment and status."""
_HEAD_BYTES = 5

Log = Callable[[float, bytes], None]


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
        late_cycles: Cycles in a row in which the bus may have no room for our frames, or in which a
            node may answer twice.

    Attributes:
        counts: What has gone wrong so far.
        sync_time: Unix time of the last SYNC.
        sent: (R, n, 8) RPDO bytes sent with it, as they lie in memory until the next exchange.
        answered: (T, n, 8) TPDO bytes, likewise.
    """

    def __init__(
        self,
        port: FramePort,
        mapping: Mapping,
        nodes: Sequence[int],
        period_s: float,
        *,
        master_id: int = 127,
        notify: Notify | None = None,
        log: Log | None = None,
        late_cycles: int = 3,
    ) -> None:
        self._port = port if log is None else LoggedPort(port, log)
        self._commands, self._answers = Commands(mapping, nodes), Answers(mapping, nodes)
        sync = bytearray(pack_frame(SYNC_COB_ID, b""))
        self._send_all = sending(self._port, [sync, *self._commands.frames])
        self.sent, self.answered = self._commands.data, self._answers.data
        self.counts = Counts()
        self._watch = NodeWatch(nodes, self._answers.cob_ids, self.counts, notify, late_cycles)
        self._collector = Collector(self._port, self._answers, self._watch)
        self._inputs = Inputs.none_yet(len(nodes))
        self._period_s, self._device_s, self._beat_at = period_s, 0.0, 0.0
        self._beat = pack_frame(HEARTBEAT_COB_ID + master_id, _OPERATIONAL)
        self._marker_id = tpdo_cob_id(1, master_id)
        self._announced: tuple[int, int] | None = None
        self._synced_s = self.sync_time = 0.0

    @property
    def cycle(self) -> int:
        """See `Cyclic`."""
        return self._watch.cycle

    @property
    def synced_s(self) -> float:
        """See `Cyclic`."""
        return self._synced_s

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """See `Cyclic`; the same `Inputs` every time."""
        self._begin(outputs, give_up_s)
        self._collector.collect(self._inputs, self._synced_s, give_up_s)
        return self._inputs

    def idle(self, until_s: float) -> None:
        """See `Cyclic`."""
        self._collector.idle(until_s)

    def pump(self, until_s: float) -> None:
        """See `Cyclic`; also sends the master's heartbeat."""
        then = time.monotonic()
        while then < until_s:
            self._send_beat()
            raw = self._port.receive(min(until_s, then + PUMP_S))
            if raw is not None and raw[:_HEAD_BYTES] not in self._answers.slots:
                self._watch.heard(raw)
            now = time.monotonic()
            self._device_s += now - then
            self._watch.look(self._device_s)
            then = now

    def news(self) -> News | None:
        """See `Cyclic`."""
        return self._watch.take_news()

    def watch(self, on: bool) -> None:
        """Whether overdue heartbeats and boot-ups of the drives are news, from now on."""
        self._watch.watch(on)

    def _begin(self, outputs: Outputs, give_up_s: float) -> None:
        """Send all that is ours, SYNC as early as may be."""
        self._commands.pack(outputs)
        if (told := (outputs.segment, outputs.status)) != self._announced:
            self._announced = told
            self._send(pack_frame(self._marker_id, MARKER.pack(*told)))
        self._watch.cycle += 1
        self._synced_s = time.monotonic()
        self._device_s += self._period_s
        self.sync_time = time.time()
        slack_s = min(SLACK_SHARE * (give_up_s - self._synced_s), MOST_SLACK_S)
        if not self._send_all(self._synced_s + slack_s):
            self._watch.overflow()
        if self._device_s >= self._beat_at:
            self._send_beat()
        if self._device_s >= self._watch.look_at:
            self._watch.look(self._device_s)

    def _send(self, frame: bytes) -> None:
        if not self._port.send(frame):
            self._watch.overflow()

    def _send_beat(self) -> None:
        if self._device_s >= self._beat_at:
            self._beat_at = self._device_s + BEAT_S
            self._send(self._beat)


class LoggedPort:
    """A port of which every frame is told, in the order in which this end sees them.

    Args:
        port: The port.
        log: Gets Unix time and 16 bytes.
    """

    def __init__(self, port: FramePort, log: Log) -> None:
        self._port, self._log = port, log

    def send(self, frame: bytes | memoryview) -> bool:
        """See `FramePort`."""
        sent = self._port.send(frame)
        if sent:
            self._log(time.time(), bytes(frame))
        return sent

    def receive(self, until_s: float) -> bytes | None:
        """See `FramePort`."""
        raw = self._port.receive(until_s)
        if raw is not None:
            self._log(time.time(), raw)
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        return self._port.wait(until_s)
