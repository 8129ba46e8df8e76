"""Reading the rows of the PLC's ring, and following the arm by them.

The PLC writes a row per cycle into a ring; `Ring` pulls them in blocks, every row once and in
order, and counts rows that were overwritten before they were read. A row has its number at both
ends, so a row that is being written while it is read is noticed and read again. `Watch` follows the
arm by these rows and the PLC's state: does it move, was it taken by another client, does the PLC's
task run? `Reading` puts both together: it waits for a block as long as time allows, and gives a
motion up when the PLC is silent. `state_rows` and `reading_rows` turn rows of the ring into the
base record and a topic of their own.
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
"""Shortest pause between two requests [s]."""

LEAST_WAIT_S = 0.02
"""Shortest time that a request waits for its answer [s]."""

IDLE_ROWS_S = 5.0
"""Of an arm that was neither moved nor read for long, only the newest rows are read [s]."""


class Reading:
    """Reads from one connection.

    Args:
        controller: Connected.
        options: Of the arm.
        topic: As `reading_topic` makes it.

    Attributes:
        ring: That is read.
        watch: Follows the arm.
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
        """See `hil.robot.HasTopics`."""
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def read(self, timeout_s: float) -> StructArray:
        """See `TwinCatRobot.read`."""
        watch, controller = self.watch, self._controller
        problem, watch.problem = watch.problem, None
        if problem is not None:
            raise problem
        # No request waits for longer than the read itself.
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
        """Return the PLC's state once a block is there, or a few rows at the time-out."""
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
                    hint="is its task running? TwinCAT shows its cycle",
                )
            nap = (wanted - waiting) / rate / 2
            time.sleep(max(LEAST_NAP_S, min(nap, until - now)))

    def _state(self) -> np.void:
        """Read `stState`; give the motion up if the PLC is silent for too long."""
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
                "its task stands still",
                hint="see to TwinCAT: is the PLC in run mode, at a breakpoint, or over its cycle "
                "time?",
            )
        return state

    def _give_up(self) -> None:
        """Stop, and end the heartbeat: the PLC meets both if it goes on."""
        self.watch.faulty = True
        self._controller.beat.silence()
        with suppress(RobotConnectionError):
            self._controller.stop()


class Watch:
    """State of the arm during one connection to the PLC.

    Args:
        session: Number of this connection.
        late_s: Silence of the PLC that ends a motion [s].

    Attributes:
        problem: What the next read raises.
        faulty: Whether commands are refused until `connect` is called again.
        moving: Whether a segment was started and no row has shown its end.
        idle: Whether nothing was started since connecting, or the arm was stopped: rows that were
            not read for long may be left out then.
    """

    def __init__(self, session: int, late_s: float) -> None:
        self._session, self._late_s = session, late_s
        self._head, self._since = -1, time.monotonic()
        self._segment = -1
        self.problem: HilError | None = None
        self.faulty = self.moving = False
        self.idle = True

    def begin(self, segment: int) -> None:
        """Follow a segment that was started."""
        self._segment, self.moving, self.idle = segment, True, False
        self._since = time.monotonic()

    def advanced(self, head: int) -> bool:
        """Return whether the PLC has written rows lately.

        Args:
            head: Rows that it has written so far.
        """
        if head != self._head:
            self._head, self._since = head, time.monotonic()
        return not self.silent

    @property
    def silent(self) -> bool:
        """Whether the PLC has written no rows for too long."""
        return time.monotonic() - self._since > self._late_s

    def see(self, rows: StructArray, state: np.void, describe: Callable[[np.void], str]) -> None:
        """Update from rows and state; the next read raises the first problem that they show.

        Args:
            rows: (N,) state rows.
            state: `stState`, read before them.
            describe: Returns words for the fault in `stState`.
        """
        mine = rows[rows["segment"] == self._segment]
        if len(mine) and not mine[-1]["status"] & Status.MOVING:
            self.moving = False
        if self.faulty:
            return
        if (rows["status"] & Status.FAULT).any() or state["nPhase"] == Phase.FAULT:
            problem = RobotFault(describe(state), hint="remove its cause, then connect() again")
        elif state["nSession"] != self._session:
            problem = RobotFault(
                "the PLC has taken the arm away: it had not heard from this computer in time, "
                "or its program was started anew",
                hint="was hil suspended, or the computer busy? connect() again",
            )
        else:
            return
        self.faulty = True
        self.problem = self.problem or problem


Read = Callable[[int, int], bytes]
"""Reads bytes of the ring: from which byte on, and how many."""

SAFE_ROWS = 256
"""Oldest rows that are given up after an overrun: they would be overwritten while they are read."""

TORN_AGAIN = 3
"""How often a block with a torn row is read, at most."""


class Ring:
    """Reader of the PLC's ring of rows.

    Args:
        read: Reads its bytes.
        row: dtype of a row.
        rows: Length of the ring.
        chunk_bytes: Most that is read at once.

    Attributes:
        next: Sequence number of the row that is read next.
        gaps: How often rows were overwritten before they were read.
        lost: How many rows those were.
        skipped: Rows left out: nothing had been started, and none were read for long.
        torn: How often a block was read again because a row in it was being written.
    """

    def __init__(self, read: Read, row: np.dtype[Any], rows: int, chunk_bytes: int) -> None:
        self._read, self._row, self._rows = read, row, rows
        self._most = max(1, chunk_bytes // row.itemsize)
        self.next = self.gaps = self.lost = self.skipped = self.torn = 0
        self._behind_gap = -1

    def begin(self, head: int) -> None:
        """Begin to read at the row with this number."""
        self.next = head

    def forget(self, head: int, keep: int) -> None:
        """Leave out what is older than the newest `keep` rows before `head`."""
        if head - self.next > keep:
            self.skipped += head - keep - self.next
            self.next = head - keep

    def pull(self, head: int) -> StructArray:
        """Return (N,) rows that have been written and not been read.

        Args:
            head: Rows written so far; the newest has the number before it.

        Raises:
            RobotConnectionError: The PLC's program was restarted, or rows have wrong numbers.
        """
        if head < self.next:
            raise RobotConnectionError(
                f"the PLC's program was started anew: {head} rows written, {self.next} were read",
                hint="see to the PLC, then connect again",
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
        """Read rows that are adjacent in memory: fewer than `count` at the end of the ring."""
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
                # Overtaken while reading: the rest of this lap begins behind the newest.
                self._skip_to(newest - self._rows + 1 + min(SAFE_ROWS, self._rows // 2))
                return rows[:0]
            self.torn += 1
        raise RobotConnectionError(
            f"row {self.next} of the PLC's ring is none: its number is "
            f"{int(rows['nSequence'][0])} and {int(rows['nSequenceEnd'][0])}",
            hint="is another program running in the PLC? connect again",
        )

    def _skip_to(self, number: int) -> None:
        """Give up the rows before this number; gaps without a row between them count as one."""
        self.gaps += self.next != self._behind_gap
        self.lost += number - self.next
        self.next = self._behind_gap = number


NS = 1e-9

_FIELDS = {
    "q": "aQ", "qd": "aQd", "effort": "aEffort", "q_target": "aQTarget",
    "qd_target": "aQdTarget", "qdd_target": "aQddTarget", "segment": "nSegment",
    "status": "nStatus", "fault_code": "nFault", "mode": "nPhase",
}  # fmt: skip
"""Field of the base record ← field of a row."""


def state_rows(raw: StructArray, offers: int) -> StructArray:
    """Return rows of the ring as the base robot record, without `host_time`.

    Args:
        raw: (N,) rows.
        offers: `nOffers`; quantities that the PLC does not measure become NaN.
    """
    rows = np.zeros(len(raw), state_dtype(raw.dtype["aQ"].shape[0]))
    rows["device_time"] = raw["nTimeNs"] * NS
    for name, ring_name in _FIELDS.items():
        rows[name] = raw[ring_name]
    rows["temperature"] = raw["aCelsius"] if offers & TEMPERATURES else np.nan
    rows["effort_target"] = raw["aEffortTarget"] if offers & EFFORT_TARGETS else np.nan
    return rows


class HostClock:
    """This computer's times of rows, spread over the time since the last block."""

    def __init__(self) -> None:
        self._device = self._host = np.nan

    def stamp(self, rows: StructArray, now: float, period_s: float) -> None:
        """Fill in `host_time`.

        Args:
            rows: (N,) state rows, N ≥ 1.
            now: Unix time at which the newest was there [s].
            period_s: Of the rows [s].
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
    """Return the topic about the reading itself: each row's number, and the rows lost before it.

    Args:
        rate_hz: Rows per second [Hz].
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
    """Return the topic's rows for a block.

    Args:
        rows: (N,) state rows.
        raw: (N,) the same rows of the ring.
        ring: Which has just read them.
        topic: As `reading_topic` makes it.
    """
    reading = topic.blank(len(rows))
    reading["device_time"], reading["host_time"] = rows["device_time"], rows["host_time"]
    reading["sequence"], reading["waited"] = raw["nSequence"], len(rows)
    reading["gaps"], reading["lost"], reading["skipped"] = ring.gaps, ring.lost, ring.skipped
    return reading
