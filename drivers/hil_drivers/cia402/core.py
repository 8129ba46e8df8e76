"""Cyclic exchange in a thread that owns the bus, and the commands of other threads to it.

`Core._cycle` executes one cycle in five steps: wait until the cycle is due, exchange process data,
check the answers (supervisor), write the next set-points (player), and store a record. A cycle
allocates little memory and uses almost no locks. Garbage is collected only when the cycle thread
starts the collection.

Other threads give commands by `enable`, `start`, `stop` and similar methods. The command methods
never access the bus: each method queues an action that the cycle thread executes between two cycles
(`_obey`), or sets a flag that the cycle thread reads. Other threads take the records in blocks from
a `Ring`, into which only the cycle thread writes. If an exception occurs in the cycle thread, the
drives get a final quick stop, and every later call raises the cause.
"""

from __future__ import annotations

import contextlib
import gc
import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.core import (
    CommandRefused,
    FloatArray,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StructArray,
)
from hil_drivers.cia402.bus import Cyclic, Inputs, Outputs
from hil_drivers.cia402.mapping import Mapping
from hil_drivers.cia402.options import LATE_CYCLES_SIMULATED
from hil_drivers.cia402.player import Player, farthest
from hil_drivers.cia402.rows import LATE, STALLED, cycle_dtype
from hil_drivers.cia402.supervisor import Phase, Supervisor
from hil_drivers.cia402.timing import TOLD_AFTER_S, Schedule, Stalls, realtime
from hil_drivers.cia402.track import Track

POLL_S = 0.002
FIRST_ANSWER_S = 2.0

ENABLED_WITHIN_S, CHANGED_WITHIN_S = 10.0, 5.0
"""Longest time for enabling all axes, and for any other change of state or mode [s]."""

SETTLE_S, MEAN_S = 0.2, 0.1
"""Device time of the wait before a torque measurement, and of the measurement [s]."""

END_S = 3.0
"""Device time that all axes get for braking and switching off [s].

`END_S` is longer than the time after which the voltage of axes that do not brake is disabled
(`braking`).
"""

JOIN_S = 1.5
LAST_CYCLES = 3
REST_RAD_S = 0.02
REST_OVER_S = 0.05

REST_WITHIN_S = 2.0
"""Longest wait for the arm to come to rest [s].

The arm is at rest if the speed of no joint, averaged over `REST_OVER_S`, exceeds `REST_RAD_S`.
"""

KEPT_S = 60.0
"""Capacity of the record queue in device time [s]."""

STOP_RAD_S2 = 8.0
FREE_BATCH = 16

BATCH_S = 0.016
"""Wall time of the records that are delivered together with one wake-up of the reader [s]."""

PUMP_S = 0.02
CLEAN_UP_S = 5.0
LAST_WORDS_S = 0.002


class Core:
    """Cyclic exchange of all axes, in a separate thread.

    Before `run` and after `rest`, the thread only receives frames (`Cyclic.pump`), so that requests
    of other threads are answered. Between `run` and `rest`, the thread executes cycles, whether or
    not the axes are enabled.

    Args:
        cyclic: Process data exchange with the drives.
        supervisor: Supervisor of the axes; writes controlwords and modes to `outputs`.
        player: Player of motions; writes set-points to `outputs`.
        outputs: Object with the commands to the drives, written by supervisor and player.
        schedule: Start times of the cycles.
        mapping: PDO mapping of every axis.
        period_s: Device time of a cycle [s].
        wall_period_s: Wall time of a cycle [s]; 0 if cycles have no deadlines.
        kept_s: Capacity of the record queue in device time [s].
        late_cycles: Number of periods without a SYNC after which a motion is stopped.
        stop_rad_s2: Deceleration of the stop after missing SYNCs [rad/s²].
        celsius: (n,) motor temperatures [°C], written by the receiver of the drives' answers and
            copied into every record; None if the drives report no temperatures.

    Attributes:
        temperature: (n,) motor temperatures [°C]; all NaN if `celsius` is None.
        not_permitted: Real-time settings that the kernel refused, as text.
        ring: Queue of the cycle records.
        schedule: Start times of the cycles.
    """

    def __init__(
        self,
        cyclic: Cyclic,
        supervisor: Supervisor,
        player: Player,
        outputs: Outputs,
        schedule: Schedule,
        mapping: Mapping,
        *,
        period_s: float,
        wall_period_s: float,
        kept_s: float = KEPT_S,
        late_cycles: int = LATE_CYCLES_SIMULATED,
        stop_rad_s2: float = STOP_RAD_S2,
        celsius: FloatArray | None = None,
    ) -> None:
        n = len(outputs.controlword)
        self._cyclic, self._supervisor, self._player = cyclic, supervisor, player
        self._outputs, self.schedule = outputs, schedule
        self._period_s, self._free = period_s, wall_period_s <= 0.0
        self._slower = wall_period_s / period_s  # ratio of wall time to device time
        batch = FREE_BATCH if self._free else max(1, math.ceil(BATCH_S / wall_period_s))
        self.temperature: FloatArray = np.full(n, np.nan) if celsius is None else celsius
        self.ring = Ring(mapping, self.temperature, max(64, round(kept_s / period_s)), batch)
        self.not_permitted: list[str] = []
        self._stalls = Stalls(period_s, late_cycles, real=wall_period_s == period_s)
        self._stop_rad_s2, self._stalled, self._tell_at = stop_rad_s2, "", 0
        self._inputs = Inputs.none_yet(n)
        self._requests: deque[Callable[[], None]] = deque()
        self._cycling = self._ending = False
        self._clean_up_at = 0
        self._problem = ""
        self._gone: RobotConnectionError | None = None
        self._thread: threading.Thread | None = None

    @property
    def phase(self) -> Phase:
        """Present phase of all axes, as in `Supervisor.phase`."""
        return self._supervisor.phase

    def open(self) -> None:
        """Start the thread, which only receives frames until `run` is called. Idempotent."""
        if self._thread is None:
            self._ending = False
            self._thread = threading.Thread(target=self._run, name="cia402 cycles", daemon=True)
            self._thread.start()

    def run(self) -> None:
        """Start the cycles and wait for the first answers; the drives must be operational.

        Raises:
            RobotTimeout: A drive does not answer in the first cycles.
            RobotConnectionError: The connection to the bus is lost.
        """
        self._require_bus()
        first = self._cyclic.cycle
        self._cycling = True
        until = time.monotonic() + FIRST_ANSWER_S
        while self._cyclic.cycle <= first + 2 or not all(self._inputs.fresh):
            self._require_bus()
            if time.monotonic() > until:
                raise self._unanswered()
            time.sleep(POLL_S)
        self._do(lambda: self._cyclic.watch(True))

    def rest(self) -> None:
        """Switch all axes off and end the cycles, after braking an arm that still moves.

        After `rest` the thread only receives frames, as before `run`.
        """
        if self._player.moving:
            self.quick_stop()
        else:
            with contextlib.suppress(HilError):
                self.disable()
        self._await_off()
        self._cyclic.watch(False)
        self._cycling = False

    def enable(self, mode: int) -> None:
        """Enable all axes in a mode, with preloaded targets; block until all axes are enabled.

        Raises:
            RobotTimeout: An axis is not enabled in time; the message contains axis and state.
            RobotFault: An axis is in the fault state, or a fault occurs.
            CommandRefused: `stop` was called during enabling, or the axes are already enabled.
        """
        self._require_bus()
        if self.phase is not Phase.OFF:
            raise CommandRefused(f"the axes cannot be enabled: they are {self.phase.value}")
        self._problem = ""
        self._do(lambda: self._supervisor.enable(mode))
        self._wait_for(Phase.ENABLED, ENABLED_WITHIN_S, "the axes are not enabled")

    def switch(self, mode: int) -> None:
        """Switch the mode of enabled axes at rest and wait for the change; raise like `enable`."""
        self._require_bus()
        if self.phase is not Phase.ENABLED:
            raise CommandRefused(f"the mode cannot be switched: the axes are {self.phase.value}")
        self._require_rest()
        self._do(lambda: self._supervisor.switch(mode))
        self._wait_for(Phase.ENABLED, CHANGED_WITHIN_S, "the mode is not switched")

    def reset_faults(self) -> None:
        """Reset the faults of all axes and wait for the change; raise like `enable`."""
        self._require_bus()
        if self.phase is not Phase.OFF:
            raise CommandRefused(f"faults cannot be reset: the axes are {self.phase.value}")
        self._problem = ""
        self._do(self._supervisor.reset)
        self._wait_for(Phase.OFF, CHANGED_WITHIN_S, "the faults are not reset")

    def disable(self) -> None:
        """Switch all axes off at rest and wait for the change; raise like `enable`."""
        if self._is_cycling and self.phase is not Phase.OFF:
            self._do(self._supervisor.disable)
            self._wait_for(Phase.OFF, CHANGED_WITHIN_S, "the axes are not off")

    def prepare(self, track: Track) -> None:
        """Store the next motion for `start`. Raises `CommandRefused`."""
        self._player.load(track)

    def start(self) -> None:
        """Start the prepared motion with the next cycle. Raises `CommandRefused`."""
        self._require_bus()
        self._player.start()

    def stop(self, deceleration_rad_s2: float) -> None:
        """Brake along the path from the next cycle on, or cancel enabling; never raise or block."""
        self._player.stop(deceleration_rad_s2)
        if self.phase in (Phase.MODE, Phase.ENABLING, Phase.RESETTING):
            self._requests.append(self._supervisor.quick_stop)

    def quick_stop(self, why: str = "") -> None:
        """Send the quick-stop controlword to all axes with the next cycle; never raise or block."""
        self._requests.append(lambda: self._supervisor.quick_stop(why))

    def mean_torque(self) -> list[float]:
        """Measure the mean torque of each axis of a holding arm, as raw value; block meanwhile.

        Raises:
            RobotConnectionError: The connection to the bus is lost.
        """
        begin = self._cyclic.cycle + round(SETTLE_S / self._period_s)
        end, seen = begin + max(1, round(MEAN_S / self._period_s)), dict[int, list[int]]()

        def goes_on() -> bool:
            now = self._cyclic.cycle
            if now >= begin:
                seen[now] = self._inputs.torque.copy()
            return now < end and self._gone is None

        self._let_pass(goes_on, FIRST_ANSWER_S * max(1.0, self._slower))
        self._require_bus()
        rows = list(seen.values()) or [self._inputs.torque.copy()]
        return [sum(column) / len(rows) for column in zip(*rows, strict=True)]

    def take_problem(self) -> str:
        """Return and clear the problem that ended a motion or enabling; empty if there was none."""
        problem, self._problem = self._problem, ""
        return problem

    def take(self, timeout_s: float) -> StructArray:
        """Return the cycle records since the last call (`rows.cycle_dtype`), at least one record.

        The returned records are in the order of the cycles.

        Raises:
            RobotTimeout: No record became available within the timeout.
            RobotConnectionError: The connection to the bus is lost, and all earlier records were
                already returned.
        """
        block = self.ring.take(0.0 if self._gone else timeout_s)
        if len(block):
            return block
        self._require_bus()
        raise RobotTimeout(
            f"no cycle ended within {timeout_s:g} s",
            hint="check whether the computer is overloaded",
        )

    def close(self) -> None:
        """Brake and switch off the axes that are on, then end the thread. Idempotent."""
        thread = self._thread
        if thread is None:
            return
        if self._is_cycling and self.phase is not Phase.OFF:
            self.quick_stop()
            self._await_off()
        self._ending = True
        self.ring.wake()
        thread.join(JOIN_S)
        self._thread = None

    @property
    def _is_cycling(self) -> bool:
        return self._cycling and self._gone is None

    def _do(self, action: Callable[[], None]) -> None:
        """Execute an action in the cycle thread and wait until it is done."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        self._requests.append(act)
        while not done.wait(0.05):
            self._require_bus()

    def _wait_for(self, phase: Phase, within_s: float, else_text: str) -> None:
        self._let_pass(lambda: self._is_on_the_way_to(phase), within_s)
        self._require_bus()
        if self.phase is phase and not self._problem:
            return
        if problem := self.take_problem():
            kind = RobotTimeout if self._supervisor.overdue else RobotFault
            raise kind(problem, hint="check this drive, then connect again")
        if self.phase in (Phase.OFF, Phase.BRAKING):
            raise CommandRefused(f"{else_text}: the axes were stopped meanwhile")
        raise RobotTimeout(
            f"{else_text} after {within_s:g} s: still {self.phase.value}",
            hint="check the drives with `hil doctor --station FILE` and at their displays",
        )

    def _is_on_the_way_to(self, phase: Phase) -> bool:
        if self._problem or self._gone:
            return False
        return self._supervisor.complains or self.phase not in (phase, Phase.OFF)

    def _let_pass(self, as_long_as: Callable[[], bool], most_s: float) -> None:
        until = time.monotonic() + most_s
        while as_long_as() and time.monotonic() < until:
            time.sleep(POLL_S)

    def _await_off(self) -> None:
        """Wait until all axes are off, for at most `END_S` of device time."""
        self._let_pass(
            lambda: self._is_cycling and self.phase is not Phase.OFF, END_S * max(1.0, self._slower)
        )
        # The last command is sent with the next cycle and applied one cycle later.
        over = self._cyclic.cycle + LAST_CYCLES
        self._let_pass(lambda: self._is_cycling and self._cyclic.cycle < over, JOIN_S)

    def _require_bus(self) -> None:
        if self._gone is not None:
            raise RobotConnectionError(self._gone.message, hint=self._gone.hint)
        if self._thread is None:
            raise RobotConnectionError("the bus is not open", hint="connect first")

    def _require_rest(self) -> None:
        """Raise `CommandRefused` if a motion is commanded or the arm does not come to rest."""
        if self._player.moving:
            raise CommandRefused("the mode cannot be switched: the arm moves", hint="stop it first")
        until = self._cyclic.cycle + REST_WITHIN_S / self._period_s
        while (speed := self._speed())[0] > REST_RAD_S:
            if self._cyclic.cycle > until:
                raise CommandRefused(
                    f"the mode cannot be switched: axis {speed[1] + 1} does not come to a "
                    f"standstill, it moves at {speed[0]:.3f} rad/s",
                    hint="find out what moves the axis",
                )

    def _speed(self) -> tuple[float, int]:
        """Return speed [rad/s] and number of the fastest joint, averaged over `REST_OVER_S`."""
        before, since = self._inputs.position.copy(), self._cyclic.cycle
        cycles = math.ceil(REST_OVER_S / self._period_s)
        self._let_pass(lambda: self._cyclic.cycle < since + cycles, FIRST_ANSWER_S)
        lasted_s = max(self._cyclic.cycle - since, 1) * self._period_s
        way, axis = farthest(self._inputs.position, before, self._player.scale)
        return way / lasted_s, axis

    def _unanswered(self) -> RobotTimeout:
        silent = [str(axis + 1) for axis, came in enumerate(self._inputs.fresh) if not came]
        return RobotTimeout(
            f"no process data from axis {', '.join(silent) or 'any'} within {FIRST_ANSWER_S:g} s",
            hint="check that the drives are operational, that SYNC is enabled (1005h) and that "
            "their PDOs are mapped",
        )

    # -- the thread that owns the bus

    def _run(self) -> None:
        try:
            while not self._ending:
                if self._cycling:
                    self._run_cycles()
                else:
                    self._cyclic.pump(time.monotonic() + PUMP_S)
                    self._obey()
        except RobotConnectionError as error:
            self._fail(error)
        except Exception as error:  # else the error ends the thread without a message
            self._last_words()
            self._fail(
                RobotConnectionError(
                    f"the cyclic exchange failed: {error!r}",
                    hint="check that the bus is up and the drives are on",
                )
            )

    def _run_cycles(self) -> None:
        self.schedule.restart()
        self._stalls.restart()
        # Without deadlines no cycle is late; a real-time thread that never sleeps blocks others.
        punctual: contextlib.AbstractContextManager[list[str]] = realtime()
        if self._free:
            punctual = contextlib.nullcontext([])
        with punctual as self.not_permitted:
            while self._cycling and not self._ending:
                self._cycle()
                self.schedule.done()

    def _cycle(self) -> None:
        late = self.schedule.wait(self._cyclic.idle)
        if self._requests:
            self._obey()
        outputs, supervisor, player = self._outputs, self._supervisor, self._player
        announced = outputs.segment, outputs.status
        self.ring.begin()
        inputs = self._inputs = self._cyclic.exchange(outputs, self.schedule.give_up)
        flags = LATE if late else 0
        if self._stalls.synced(self._cyclic.synced_s):
            flags |= STALLED
            self._catch_up()
        if (news := self._cyclic.news()) is not None:
            supervisor.hear(news)
        supervisor.step(inputs, self._cyclic.cycle)
        if supervisor.running:
            if supervisor.phase is Phase.ENABLED and player.mode != supervisor.mode:
                player.engage(supervisor.mode, outputs)
            player.step(inputs, outputs)
        else:
            self._be_off()
        if self._stalled and self._cyclic.cycle >= self._tell_at:
            self._tell("")
        self._keep(announced, flags)
        if self.schedule.cycles >= self._clean_up_at:
            self._clean_up()

    def _keep(self, announced: tuple[int, int], flags: int) -> None:
        ring = self.ring
        if ring.full:
            self._make_room()
        fresh = self._inputs.fresh
        complete = all(fresh)
        if self._free:
            self.schedule.answered(complete)
        if not complete:
            flags |= sum(1 << axis for axis, came in enumerate(fresh) if not came)
        ring.put(self._cyclic, announced, self._supervisor.fault_code, flags)

    def _make_room(self) -> None:
        """Drop old records of an arm at rest; stop a motion whose records are not read in time."""
        if self._free:
            self.ring.wait_for_room(time.monotonic() + 1.0)
        if not self.ring.full:
            return
        if self._player.moving:
            self._supervisor.quick_stop(
                "the records of the cycles were not read in time: hil is delayed (busy computer, "
                "slow disk)"
            )
        self.ring.forget(max(1, round(1.0 / self._period_s)))

    def _be_off(self) -> None:
        if self._player.mode:
            self._player.disengage()
        self._outputs.segment, self._outputs.status = -1, 0
        if problem := self._supervisor.take_problem():
            self._tell(problem)

    def _catch_up(self) -> None:
        """Stop a motion along its path after a long gap between two SYNCs."""
        if self._stalls.too_long and self._player.moving and not self._stalled:
            self._player.stop(self._stop_rad_s2)
            self._stalled = self._stalls.text
            self._tell_at = self._cyclic.cycle + round(TOLD_AFTER_S / self._period_s)

    def _tell(self, problem: str) -> None:
        """Store a problem for `take_problem`, with the gap between SYNCs that can be its cause."""
        self._problem = "; ".join(filter(None, (self._stalled, problem)))
        self._stalled = ""
        self.ring.wake()

    def _clean_up(self) -> None:
        """Collect young garbage periodically, because automatic collection is off in the cycles."""
        self._clean_up_at = self.schedule.cycles + round(CLEAN_UP_S / self._period_s)
        gc.collect(0)

    def _obey(self) -> None:
        while self._requests:
            self._requests.popleft()()

    def _last_words(self) -> None:
        """Send a quick stop to all axes twice, because the second SYNC applies the commands."""
        with contextlib.suppress(Exception):
            self._supervisor.quick_stop()
            for _ in range(2):
                self._cyclic.exchange(self._outputs, time.monotonic() + LAST_WORDS_S)

    def _fail(self, error: RobotConnectionError) -> None:
        self._player.disengage()
        self._gone = error
        self.ring.wake()


class Ring:
    """Queue of cycle records (`rows.cycle_dtype`) with a fixed capacity.

    Args:
        mapping: PDO mapping of every axis.
        temperature: (n,) motor temperatures [°C]; the present values are copied into each record.
        capacity: Maximum number of waiting records.
        batch: Number of waiting records at which the thread in `take` is woken.

    Attributes:
        forgotten: Number of records that were dropped because no thread had taken them.
    """

    def __init__(
        self, mapping: Mapping, temperature: FloatArray, capacity: int, batch: int = 1
    ) -> None:
        self._rows = np.zeros(capacity, dtype=cycle_dtype(mapping, len(temperature)))
        self._memory, self._row_bytes = self._rows.view(np.uint8).data, self._rows.itemsize
        self._packing = _packing(self._rows.dtype)
        self._capacity, self._batch = capacity, batch
        self._written = self._taken = 0
        self._asleep = False
        self._bell, self._moving = threading.Lock(), threading.Lock()
        self._temperature, self._celsius = temperature, temperature.tobytes()
        self.forgotten = 0

    @property
    def full(self) -> bool:
        """Whether the queue has no space for another record."""
        return self._written - self._taken >= self._capacity

    def begin(self) -> None:
        """Begin the record of a cycle with the temperatures known at the start of the cycle.

        The record does not contain temperatures that are received during the cycle: a log of the
        bus shows which frames precede a SYNC, but not when the answers to the SYNC were processed.
        """
        self._celsius = self._temperature.tobytes()

    def put(self, cyclic: Cyclic, announced: tuple[int, int], fault_code: int, flags: int) -> None:
        """Write the record of the last exchange into the ring, which must have space.

        Args:
            cyclic: Process data after the exchange.
            announced: Segment and status announced in this cycle.
            fault_code: EMCY code of the first faulty axis; 0 without a fault.
            flags: Flags of the cycle: `INCOMPLETE`, `STALLED`, `LATE` of `rows`.
        """
        self._packing.pack_into(
            self._memory,
            self._written % self._capacity * self._row_bytes,
            cyclic.cycle,
            cyclic.sync_time,
            self._celsius,
            *announced,
            fault_code,
            flags,
            cyclic.sent.tobytes(),
            cyclic.answered.tobytes(),
        )
        self._written += 1  # the record is visible to readers from here on
        if self._asleep and self._written - self._taken >= self._batch:
            self.wake()

    def forget(self, count: int) -> None:
        """Drop a number of the oldest records."""
        with self._moving:
            count = min(count, self._written - self._taken)
            self._taken += count
            self.forgotten += count

    def wake(self) -> None:
        """Wake the thread in `take`, which then returns the records stored so far."""
        self._asleep = False
        with contextlib.suppress(RuntimeError):  # already released
            self._bell.release()

    def take(self, timeout_s: float) -> StructArray:
        """Return all waiting records in the order of the cycles; no records after a timeout.

        Only one thread may call this method.
        """
        if self._written == self._taken:
            self._bell.acquire(blocking=False)
            self._asleep = True
            if self._written == self._taken:
                self._bell.acquire(timeout=timeout_s)
            self._asleep = False
        with self._moving:
            stop = self._written
            block = self._copy(self._taken, stop)
            self._taken = stop  # last, because the freed space is overwritten from here on
        return block

    def wait_for_room(self, until_s: float) -> None:
        """Wait until a quarter of the queue is free, or until a time of `time.monotonic` [s]."""
        while self._written - self._taken > 0.75 * self._capacity and time.monotonic() < until_s:
            time.sleep(0.002)

    def _copy(self, start: int, stop: int) -> StructArray:
        first, last = start % self._capacity, stop % self._capacity
        if first < last or start == stop:
            return self._rows[first:last].copy()
        return np.concatenate([self._rows[first:], self._rows[:last]])


_CODES = {"<i8": "q", "<f8": "d", "<i4": "i"}


def _packing(row: np.dtype[Any]) -> struct.Struct:
    """Return the `struct` layout that packs a whole record at once, with arrays as bytes."""
    fields = [row[name] for name in row.names or ()]
    codes = [f"{field.itemsize}s" if field.shape else _CODES[field.str] for field in fields]
    return struct.Struct("<" + "".join(codes))
