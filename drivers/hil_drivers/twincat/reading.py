"""Reader of the rows in the PLC's ring buffer, and detector of the arm's state.

The PLC writes one row per cycle into a ring buffer. `Ring` fetches the rows in blocks: each row
exactly one time and in order. `Ring` also counts rows that were overwritten before they were read.
A row contains its number at both ends. From the two numbers, `Ring` detects a row that was read
while the PLC wrote the row, and reads the row again. `Watch` determines from the rows and from the
PLC's state whether the arm moves, whether another client controls the arm, and whether the PLC's
task runs. `Reading` combines `Ring` and `Watch`: a read waits for a block until the time-out, and
ends a motion if the PLC writes no rows. `state_rows` and `reading_rows` convert rows of the ring
buffer to the base record and to a separate topic.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from hil.core import HilError, RobotConnectionError, RobotFault, RobotTimeout, StructArray
from hil.robot import Status, Topic, state_dtype
from hil_drivers.twincat.controller import Controller
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.variables import EFFORT_TARGETS, TEMPERATURES, Phase

LEAST_NAP_S = 1e-3
"""Minimum pause between two requests to the PLC [s]."""

LEAST_WAIT_S = 0.02
"""Minimum time-out of a request to the PLC [s]."""

IDLE_ROWS_S = 5.0
"""Duration of the newest rows that are read for an idle arm [s]; older rows are skipped."""


class Reading:
    """Reader of the rows during one connection to the PLC.

    Args:
        controller: Connected controller.
        options: Options of the arm.
        topic: Topic from `reading_topic`.

    Attributes:
        ring: Reader of the PLC's ring buffer.
        watch: State of the arm.
    """

    def __init__(self, controller: Controller, options: Options, topic: Topic) -> None:
        self._controller, self._options, self._topic = controller, options, topic
        variables = controller.variables
        self.ring = Ring(
            lambda at, size: variables.read("aRing", at, size),
            variables.layout.row,
            int(controller.info["nRingRows"]),
            options.chunk_bytes,
        )
        self.ring.begin(int(controller.state()["nHead"]))
        self.watch = Watch(controller.session, options.late_s)
        self._clock = HostClock()
        self._further: list[StructArray] = []

    def drain(self) -> Mapping[str, StructArray]:
        """Return the rows about the reading since the last call; see `hil.robot.HasTopics`."""
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def read(self, timeout_s: float) -> StructArray:
        """See `TwinCatRobot.read`."""
        watch, controller = self.watch, self._controller
        problem, watch.problem = watch.problem, None
        if problem is not None:
            raise problem
        # A request must not wait longer than the read itself.
        controller.wait_for(max(timeout_s, LEAST_WAIT_S))
        try:
            state = self._await_rows(timeout_s)
            now = time.time()
            if watch.idle and not watch.moving:
                self.ring.forget(int(state["nHead"]), round(IDLE_ROWS_S * self._options.rate_hz))
            raw = self.ring.pull(int(state["nHead"]))
        except (RobotConnectionError, RobotFault):
            watch.faulty = True
            raise
        finally:
            controller.wait_for()
        rows = state_rows(raw, int(controller.info["nOffers"]))
        self._clock.stamp(rows, now, 1.0 / self._options.rate_hz)
        self._further.append(reading_rows(rows, raw, self.ring, self._topic))
        watch.see(rows, state, controller.fault)
        return rows

    def _await_rows(self, timeout_s: float) -> np.void:
        """Wait for a complete block or, for a longer time, for any rows; return the PLC's state."""
        began, wanted, rate = time.monotonic(), self._options.block_rows, self._options.rate_hz
        until = began + timeout_s
        enough = min(until, began + 1.5 * wanted / rate)
        while True:
            state = self._state()
            waiting = int(state["nHead"]) - self.ring.next
            now = time.monotonic()
            if waiting >= wanted or waiting < 0 or (waiting and now >= enough):
                return state
            if now >= until:
                raise RobotTimeout(
                    f"{self._controller.where} has written no rows within {timeout_s:g} s",
                    hint="check in TwinCAT that its task runs",
                )
            nap = (wanted - waiting) / rate / 2
            time.sleep(max(LEAST_NAP_S, min(nap, until - now)))

    def _state(self) -> np.void:
        """Read `stState`; end the motion if the PLC has written no rows for too long."""
        watch, controller = self.watch, self._controller
        try:
            state = controller.state()
        except RobotTimeout:
            if watch.moving and watch.silent:
                self._give_up()
            raise
        if not watch.advanced(int(state["nHead"])) and watch.moving:
            self._give_up()
            raise RobotTimeout(
                f"{controller.where} has written no rows for more than {self._options.late_s:g} s: "
                "its task does not run",
                hint="check TwinCAT: is the PLC in run mode, at a breakpoint, or over its cycle "
                "time?",
            )
        return state

    def _give_up(self) -> None:
        """Send a stop and end the heartbeat; a PLC that resumes its cycle then stops the arm."""
        self.watch.faulty = True
        self._controller.beat.silence()
        with suppress(RobotConnectionError):
            self._controller.stop()


class Watch:
    """State of the arm during one connection to the PLC.

    Args:
        session: Number that identifies this connection in the PLC.
        late_s: Time without new rows of the PLC after which a motion is ended [s].

    Attributes:
        problem: Exception that the next read raises; None if there is no problem.
        faulty: Whether commands are refused until `connect` is called again.
        moving: Whether a segment was started and no row has shown its end.
        idle: Whether no segment was started since connecting or since the last stop; if True, old
            rows can be skipped.
    """

    def __init__(self, session: int, late_s: float) -> None:
        self._session, self._late_s = session, late_s
        self._head, self._since = -1, time.monotonic()
        self._segment = -1
        self.problem: HilError | None = None
        self.faulty = self.moving = False
        self.idle = True

    def begin(self, segment: int) -> None:
        """Begin to monitor a segment that was just started."""
        self._segment, self.moving, self.idle = segment, True, False
        self._since = time.monotonic()

    def advanced(self, head: int) -> bool:
        """Return whether the PLC has written rows recently.

        Args:
            head: Number of rows that the PLC has written so far.
        """
        if head != self._head:
            self._head, self._since = head, time.monotonic()
        return not self.silent

    @property
    def silent(self) -> bool:
        """Whether the PLC has written no rows for longer than `late_s`."""
        return time.monotonic() - self._since > self._late_s

    def see(self, rows: StructArray, state: np.void, describe: Callable[[np.void], str]) -> None:
        """Update the arm's state from new rows and `stState`; store a problem for the next read.

        Args:
            rows: (N,) state rows.
            state: `stState`, read before the rows.
            describe: Function that returns the text of the fault in `stState`.
        """
        mine = rows[rows["segment"] == self._segment]
        if len(mine) and not mine[-1]["status"] & Status.MOVING:
            self.moving = False
        if self.faulty:
            return
        if (rows["status"] & Status.FAULT).any() or state["nPhase"] == Phase.FAULT:
            hint = "remove the cause of the fault, then call connect() again"
            problem = RobotFault(describe(state), hint=hint)
        elif state["nSession"] != self._session:
            problem = RobotFault(
                "the PLC has released the arm: no heartbeat of this computer arrived in time, or "
                "the PLC program was restarted",
                hint="check whether hil was suspended or the computer overloaded, then call "
                "connect() again",
            )
        else:
            return
        self.faulty = True
        self.problem = self.problem or problem


Read = Callable[[int, int], bytes]
"""Function that reads bytes of the ring buffer, from the offset and number of the bytes."""

SAFE_ROWS = 256
"""Number of oldest rows skipped after an overrun, because the PLC overwrites them during a read."""

TORN_AGAIN = 3
"""Maximum number of attempts to read a block with a partly written row."""


class Ring:
    """Reader of the PLC's ring buffer of rows.

    Args:
        read: Function that reads bytes of the ring buffer.
        row: NumPy dtype of a row.
        rows: Number of rows in the ring buffer.
        chunk_bytes: Maximum number of bytes in one request.

    Attributes:
        next: Number of the row that is read next.
        gaps: Number of gaps in the sequence of rows, caused by rows that were overwritten before
            they were read.
        lost: Number of rows in the gaps.
        skipped: Number of rows that were skipped because the arm was idle and no rows were read for
            a long time.
        torn: Number of blocks that were read again because a row was being written.
    """

    def __init__(self, read: Read, row: np.dtype[Any], rows: int, chunk_bytes: int) -> None:
        self._read, self._row, self._rows = read, row, rows
        self._most = max(1, chunk_bytes // row.itemsize)
        self.next = self.gaps = self.lost = self.skipped = self.torn = 0
        self._behind_gap = -1

    def begin(self, head: int) -> None:
        """Set the number of the first row to read."""
        self.next = head

    def forget(self, head: int, keep: int) -> None:
        """Skip rows older than the newest `keep` rows before `head`."""
        if head - self.next > keep:
            self.skipped += head - keep - self.next
            self.next = head - keep

    def pull(self, head: int) -> StructArray:
        """Return (N,) rows that have been written and not yet read.

        Args:
            head: Number of rows written so far; the newest row has the number `head` − 1.

        Raises:
            RobotConnectionError: The PLC's program was restarted, or rows have wrong numbers.
        """
        if head < self.next:
            raise RobotConnectionError(
                f"the PLC program was restarted: it has written {head} rows, {self.next} were read",
                hint="check the PLC, then connect again",
            )
        if head - self.next > self._rows:
            self._skip_to(head - self._rows + min(SAFE_ROWS, self._rows // 2))
        blocks = []
        while self.next < head:
            block = self._block(min(self._most, head - self.next))
            blocks.append(block)
            self.next += len(block)
        return np.concatenate(blocks) if blocks else np.zeros(0, self._row)

    def _block(self, count: int) -> StructArray:
        """Read adjacent rows in memory: fewer than `count` at the end of the ring buffer."""
        at = self.next % self._rows
        count = min(count, self._rows - at)
        size = self._row.itemsize
        for _ in range(TORN_AGAIN):
            rows = np.frombuffer(self._read(at * size, count * size), self._row)
            expected = np.arange(self.next, self.next + count, dtype=np.uint64)
            whole = (rows["nSequence"] == expected) & (rows["nSequenceEnd"] == expected)
            if whole.all():
                return rows
            newest = int(np.minimum(rows["nSequence"], rows["nSequenceEnd"]).max())
            if newest >= self.next + self._rows:
                # Overwritten during the read: continue with the oldest rows that still exist.
                self._skip_to(newest - self._rows + 1 + min(SAFE_ROWS, self._rows // 2))
                return rows[:0]
            self.torn += 1
        raise RobotConnectionError(
            f"row {self.next} of the PLC's ring buffer is invalid: its numbers are "
            f"{int(rows['nSequence'][0])} and {int(rows['nSequenceEnd'][0])}",
            hint="check whether another program runs in the PLC, then connect again",
        )

    def _skip_to(self, number: int) -> None:
        """Skip all rows before a row number; count adjacent gaps as one."""
        self.gaps += self.next != self._behind_gap
        self.lost += number - self.next
        self.next = self._behind_gap = number


NS = 1e-9

_FIELDS = {
    "q": "aQ", "qd": "aQd", "effort": "aEffort", "q_target": "aQTarget",
    "qd_target": "aQdTarget", "qdd_target": "aQddTarget", "segment": "nSegment",
    "status": "nStatus", "fault_code": "nFault", "mode": "nPhase",
}  # fmt: skip
"""Fields of the base record, each with the field of a row that contains its value."""


def state_rows(raw: StructArray, offers: int) -> StructArray:
    """Return rows of the ring buffer as the base robot record, without `host_time`.

    Args:
        raw: (N,) rows of the ring buffer.
        offers: Value of `nOffers`, whose bits state which quantities the PLC measures; quantities
            that are not measured become NaN.
    """
    rows = np.zeros(len(raw), state_dtype(raw.dtype["aQ"].shape[0]))
    rows["device_time"] = raw["nTimeNs"] * NS
    for name, ring_name in _FIELDS.items():
        rows[name] = raw[ring_name]
    rows["temperature"] = raw["aCelsius"] if offers & TEMPERATURES else np.nan
    rows["effort_target"] = raw["aEffortTarget"] if offers & EFFORT_TARGETS else np.nan
    return rows


class HostClock:
    """Converter from the device time of rows to the time of this computer.

    The times of a block's rows are distributed over the time since the last block.
    """

    def __init__(self) -> None:
        self._device = self._host = np.nan

    def stamp(self, rows: StructArray, now: float, period_s: float) -> None:
        """Fill in the field `host_time` of the rows.

        Args:
            rows: (N,) state rows, N ≥ 1.
            now: Unix time at which the newest row was available [s].
            period_s: Period of the rows [s].
        """
        device = rows["device_time"]
        if np.isnan(self._host):
            self._device = device[0] - period_s
            self._host = now - len(rows) * period_s
        share = (device - self._device) / max(device[-1] - self._device, period_s)
        rows["host_time"] = self._host + share * (now - self._host)
        self._device, self._host = float(device[-1]), now


TOPIC = "/robot/twincat"


def reading_topic(rate_hz: float) -> Topic:
    """Return the topic about the reading, with the number of each row and counts of lost rows.

    Args:
        rate_hz: Rate of the rows [Hz].
    """
    fields = [
        ("device_time", "<f8"), ("host_time", "<f8"), ("sequence", "<i8"), ("gaps", "<i4"),
        ("lost", "<i4"), ("skipped", "<i4"), ("waited", "<i4"),
    ]  # fmt: skip
    units = {
        "device_time": "s", "host_time": "s (Unix time)", "sequence": "row, from 0",
        "gaps": "so far", "lost": "rows so far", "skipped": "rows so far, not wanted",
        "waited": "rows in the block",
    }  # fmt: skip
    return Topic(
        name=TOPIC,
        dtype=np.dtype(fields),
        rate_hz=rate_hz,
        clock="controller",
        units=units,
        schema_name="hil/msg/TwinCatRow",
    )


def reading_rows(rows: StructArray, raw: StructArray, ring: Ring, topic: Topic) -> StructArray:
    """Return the rows of the topic about the reading for one block.

    Args:
        rows: (N,) state rows.
        raw: (N,) rows of the block, as in the ring buffer.
        ring: Reader that has just fetched the rows.
        topic: Topic from `reading_topic`.
    """
    reading = topic.blank(len(rows))
    reading["device_time"], reading["host_time"] = rows["device_time"], rows["host_time"]
    reading["sequence"], reading["waited"] = raw["nSequence"], len(rows)
    reading["gaps"], reading["lost"], reading["skipped"] = ring.gaps, ring.lost, ring.skipped
    return reading
