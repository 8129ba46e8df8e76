"""The cycles: a thread that owns the bus, and what other threads ask of it.

One cycle is `Core._cycle`: wait for its time, exchange process data, have the supervisor judge the
answers, have the player write the next set-points, keep a record of it all. It allocates little and
locks almost nothing; garbage is collected at times of our choosing.

Other threads command by `enable`, `start`, `stop` and so on. They never touch the bus: what they
want is put into a queue and done by the thread between two cycles (`_obey`), or is a flag that it
reads. They take the records in blocks from a `Ring`, of which the thread only ever writes one end.
When anything fails in the thread, the drives get a last quick stop and every later call raises why.
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
"""How long enabling may take; other changes of state or mode [s]."""

SETTLE_S, MEAN_S = 0.2, 0.1
"""Device time before torques are measured, and over which their mean is taken [s]."""

END_S = 3.0
"""Device time for all axes to brake and be off: longer than it takes until those that do not are
taken the voltage from (`braking`) [s]."""

JOIN_S = 1.5
LAST_CYCLES = 3
REST_RAD_S = 0.02
REST_OVER_S = 0.05

REST_WITHIN_S = 2.0
"""An arm is at rest when no joint has moved faster, on average over that time."""

KEPT_S = 60.0
"""Device time of records that may wait to be taken [s]."""

STOP_RAD_S2 = 8.0
FREE_BATCH = 16

BATCH_S = 0.016
"""Wall time of records that are handed over together, so that one wake-up serves several [s]."""

PUMP_S = 0.02
CLEAN_UP_S = 5.0
LAST_WORDS_S = 0.002


class Core:
    """The cyclic exchange of all axes, in a thread of its own.

    Until `run`, and after `rest`, it only takes what comes (`Cyclic.pump`), so that requests of
    other threads are answered; between them cycles go on, enabled or not.

    Args:
        cyclic: The drives.
        supervisor, player: Write to `outputs`.
        outputs: Commands to the drives.
        schedule: When cycles begin.
        mapping: Of every axis.
        period_s: Device time of a cycle [s].
        wall_period_s: Wall time of a cycle; 0 when cycles have no deadlines [s].
        kept_s: Device time of records that may wait to be taken [s].
        late_cycles: Periods without a SYNC after which a motion is not gone on with.
        stop_rad_s2: How it is ended then.
        celsius: (n,) [°C], written by who hears the drives tell it; goes into every record.

    Attributes:
        temperature: The same; all NaN without it.
        not_permitted: What the kernel refused of what real time needs, in words.
        ring: The records.
        schedule: When cycles began.
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
        self._slower = wall_period_s / period_s  # than the time of the drives
        batch = FREE_BATCH if self._free else max(1, math.ceil(BATCH_S / wall_period_s))
        self.temperature: FloatArray = np.full(n, np.nan) if celsius is None else celsius
        self.ring = Ring(mapping, self.temperature, max(64, round(kept_s / period_s)), batch)
        self.not_permitted: list[str] = []
        self._stalls = Stalls(period_s, late_cycles, real=wall_period_s == period_s)
        self._stop_rad_s2, self._stalled, self._tell_at = stop_rad_s2, "", 0
        self._inputs = Inputs.none_yet(n)
        self._asked: deque[Callable[[], None]] = deque()
        self._cycling = self._ending = False
        self._clean_up_at = 0
        self._problem = ""
        self._gone: RobotConnectionError | None = None
        self._thread: threading.Thread | None = None

    @property
    def phase(self) -> Phase:
        """Where the axes are."""
        return self._supervisor.phase

    def open(self) -> None:
        """Start the thread, which pumps. Idempotent."""
        if self._thread is None:
            self._ending = False
            self._thread = threading.Thread(target=self._run, name="cia402 cycles", daemon=True)
            self._thread.start()

    def run(self) -> None:
        """Begin with cycles; the drives are operational. Returns after the first answers.

        Raises:
            RobotTimeout: A drive does not answer.
            RobotConnectionError: The bus is gone.
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
        """End the cycles, all axes off, and pump again; an arm that still moves is braked."""
        if self._player.moving:
            self.quick_stop()
        else:
            with contextlib.suppress(HilError):
                self.disable()
        self._await_off()
        self._cyclic.watch(False)
        self._cycling = False

    def enable(self, mode: int) -> None:
        """Enable all axes in a mode, all targets preloaded; blocks.

        Raises:
            RobotTimeout: An axis takes too long; with axis and state.
            RobotFault: An axis is in fault, or becomes so.
            CommandRefused: `stop` came meanwhile, or they are enabled.
        """
        self._require_bus()
        if self.phase is not Phase.OFF:
            raise CommandRefused(f"the axes cannot be enabled: they are {self.phase.value}")
        self._problem = ""
        self._do(lambda: self._supervisor.enable(mode))
        self._wait_for(Phase.ENABLED, ENABLED_WITHIN_S, "the axes are not enabled")

    def switch(self, mode: int) -> None:
        """Switch the mode of the enabled axes at rest; blocks, raises as `enable`."""
        self._require_bus()
        if self.phase is not Phase.ENABLED:
            raise CommandRefused(f"the mode cannot be switched: the axes are {self.phase.value}")
        self._require_rest()
        self._do(lambda: self._supervisor.switch(mode))
        self._wait_for(Phase.ENABLED, CHANGED_WITHIN_S, "the mode is not switched")

    def reset_faults(self) -> None:
        """Reset faults, on request only; blocks, raises as `enable`."""
        self._require_bus()
        if self.phase is not Phase.OFF:
            raise CommandRefused(f"faults cannot be reset: the axes are {self.phase.value}")
        self._problem = ""
        self._do(self._supervisor.reset)
        self._wait_for(Phase.OFF, CHANGED_WITHIN_S, "the faults are not reset")

    def disable(self) -> None:
        """Switch all axes off, at rest; blocks, raises as `enable`."""
        if self._is_cycling and self.phase is not Phase.OFF:
            self._do(self._supervisor.disable)
            self._wait_for(Phase.OFF, CHANGED_WITHIN_S, "the axes are not off")

    def prepare(self, track: Track) -> None:
        """Keep the next motion. Raises `CommandRefused`."""
        self._player.load(track)

    def start(self) -> None:
        """Begin the prepared motion with the next cycle. Raises `CommandRefused`."""
        self._require_bus()
        self._player.start()

    def stop(self, deceleration_rad_s2: float) -> None:
        """Brake on the way with the next cycle, or leave off enabling; never raises or blocks."""
        self._player.stop(deceleration_rad_s2)
        if self.phase in (Phase.MODE, Phase.ENABLING, Phase.RESETTING):
            self._asked.append(self._supervisor.quick_stop)

    def quick_stop(self, why: str = "") -> None:
        """Controlword quick stop to all axes with the next cycle; never raises or blocks."""
        self._asked.append(lambda: self._supervisor.quick_stop(why))

    def mean_torque(self) -> list[float]:
        """Return measured torques, raw, per axis, of an arm that holds; blocks.

        Raises:
            RobotConnectionError: The bus is gone.
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
        """All cycle records (`rows.cycle_dtype`) since the last call, in order, at least one.

        Raises:
            RobotTimeout: None came in time.
            RobotConnectionError: The bus is gone, and what came before that is taken.
        """
        block = self.ring.take(0.0 if self._gone else timeout_s)
        if len(block):
            return block
        self._require_bus()
        raise RobotTimeout(
            f"no cycle was over within {timeout_s:g} s", hint="look for a busy machine"
        )

    def close(self) -> None:
        """End the thread; axes that are on are braked before. Idempotent."""
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
        """Have the thread do it, and wait until it has."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        self._asked.append(act)
        while not done.wait(0.05):
            self._require_bus()

    def _wait_for(self, phase: Phase, within_s: float, else_text: str) -> None:
        self._let_pass(lambda: self._is_on_the_way_to(phase), within_s)
        self._require_bus()
        if self.phase is phase and not self._problem:
            return
        if problem := self.take_problem():
            kind = RobotTimeout if self._supervisor.overdue else RobotFault
            raise kind(problem, hint="see to that drive, then connect again")
        if self.phase in (Phase.OFF, Phase.BRAKING):
            raise CommandRefused(f"{else_text}: they were stopped meanwhile")
        raise RobotTimeout(
            f"{else_text} after {within_s:g} s: still {self.phase.value}",
            hint="see the drives: hil doctor --station FILE, and their displays",
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
        """Wait until all axes are off, as long as that may take by the time of the drives."""
        self._let_pass(
            lambda: self._is_cycling and self.phase is not Phase.OFF, END_S * max(1.0, self._slower)
        )
        # The last command goes out with the next cycle and is applied in the one after it.
        over = self._cyclic.cycle + LAST_CYCLES
        self._let_pass(lambda: self._is_cycling and self._cyclic.cycle < over, JOIN_S)

    def _require_bus(self) -> None:
        if self._gone is not None:
            raise RobotConnectionError(self._gone.message, hint=self._gone.hint)
        if self._thread is None:
            raise RobotConnectionError("the bus is not open", hint="connect first")

    def _require_rest(self) -> None:
        """Raises `CommandRefused` when the arm is commanded to move, or does not come to rest."""
        if self._player.moving:
            raise CommandRefused("the mode cannot be switched: the arm moves", hint="stop it first")
        until = self._cyclic.cycle + REST_WITHIN_S / self._period_s
        while (speed := self._speed())[0] > REST_RAD_S:
            if self._cyclic.cycle > until:
                raise CommandRefused(
                    f"the mode cannot be switched: axis {speed[1] + 1} does not come to rest, it "
                    f"moves at {speed[0]:.3f} rad/s",
                    hint="see to what moves it",
                )

    def _speed(self) -> tuple[float, int]:
        """Of the fastest joint [rad/s], over `REST_OVER_S`, and its axis."""
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
            hint="are the drives operational, is SYNC enabled (1005h), are their PDOs mapped?",
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
        except Exception as error:  # else it would end in this thread, unseen
            self._last_words()
            self._fail(
                RobotConnectionError(
                    f"the cyclic exchange failed: {error!r}",
                    hint="see whether the bus is up and the drives are on",
                )
            )

    def _run_cycles(self) -> None:
        self.schedule.restart()
        self._stalls.restart()
        # Without deadlines nothing is late, and a thread that never sleeps must not hold up others.
        punctual: contextlib.AbstractContextManager[list[str]] = realtime()
        if self._free:
            punctual = contextlib.nullcontext([])
        with punctual as self.not_permitted:
            while self._cycling and not self._ending:
                self._cycle()
                self.schedule.done()

    def _cycle(self) -> None:
        late = self.schedule.wait(self._cyclic.idle)
        if self._asked:
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

    def _keep(self, told: tuple[int, int], flags: int) -> None:
        ring = self.ring
        if ring.full:
            self._make_room()
        fresh = self._inputs.fresh
        complete = all(fresh)
        if self._free:
            self.schedule.answered(complete)
        if not complete:
            flags |= sum(1 << axis for axis, came in enumerate(fresh) if not came)
        ring.put(self._cyclic, told, self._supervisor.fault_code, flags)

    def _make_room(self) -> None:
        """Records of an arm at rest may go; those of a motion that are not taken end it."""
        if self._free:
            self.ring.wait_for_room(time.monotonic() + 1.0)
        if not self.ring.full:
            return
        if self._player.moving:
            self._supervisor.quick_stop(
                "the cycles' records were not taken: hil is held up (busy machine, slow disk)"
            )
        self.ring.forget(max(1, round(1.0 / self._period_s)))

    def _be_off(self) -> None:
        if self._player.mode:
            self._player.disengage()
        self._outputs.segment, self._outputs.status = -1, 0
        if problem := self._supervisor.take_problem():
            self._tell(problem)

    def _catch_up(self) -> None:
        """A SYNC was late: a motion does not go on at full speed after a long gap."""
        if self._stalls.too_long and self._player.moving and not self._stalled:
            self._player.stop(self._stop_rad_s2)
            self._stalled = self._stalls.text
            self._tell_at = self._cyclic.cycle + round(TOLD_AFTER_S / self._period_s)

    def _tell(self, problem: str) -> None:
        """Have it taken, with the stall that may have been its cause."""
        self._problem = "; ".join(filter(None, (self._stalled, problem)))
        self._stalled = ""
        self.ring.wake()

    def _clean_up(self) -> None:
        """Collect young garbage now and then: the collector is off while cycles go on."""
        self._clean_up_at = self.schedule.cycles + round(CLEAN_UP_S / self._period_s)
        gc.collect(0)

    def _obey(self) -> None:
        while self._asked:
            self._asked.popleft()()

    def _last_words(self) -> None:
        """Quick stop to all, twice: the second SYNC applies the first's commands."""
        with contextlib.suppress(Exception):
            self._supervisor.quick_stop()
            for _ in range(2):
                self._cyclic.exchange(self._outputs, time.monotonic() + LAST_WORDS_S)

    def _fail(self, error: RobotConnectionError) -> None:
        self._player.disengage()
        self._gone = error
        self.ring.wake()


class Ring:
    """A bounded queue of records (`rows.cycle_dtype`).

    Args:
        mapping: Of every axis.
        temperature: (n,) [°C] of all axes; the present ones go into a record.
        capacity: Records that may wait.
        batch: So many are waited for before the thread that takes is woken.

    Attributes:
        forgotten: Records dropped because they were not taken.
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
        """Whether the next record has no room."""
        return self._written - self._taken >= self._capacity

    def begin(self) -> None:
        """Begin the record of a cycle with the temperatures known by now.

        Not what is known when it ends: a log of the bus tells what came before a SYNC, but not
        when we were done with the answers to it.
        """
        self._celsius = self._temperature.tobytes()

    def put(self, cyclic: Cyclic, told: tuple[int, int], fault_code: int, flags: int) -> None:
        """Write the record of the last exchange; the ring must have room.

        Args:
            cyclic: Has exchanged.
            told: Segment and status that were announced with it.
            fault_code: See `rows.cycle_dtype`.
            flags: Likewise.
        """
        self._packing.pack_into(
            self._memory,
            self._written % self._capacity * self._row_bytes,
            cyclic.cycle,
            cyclic.sync_time,
            self._celsius,
            *told,
            fault_code,
            flags,
            cyclic.sent.tobytes(),
            cyclic.answered.tobytes(),
        )
        self._written += 1  # from here on it is seen
        if self._asleep and self._written - self._taken >= self._batch:
            self.wake()

    def forget(self, count: int) -> None:
        """Drop the oldest records."""
        with self._moving:
            count = min(count, self._written - self._taken)
            self._taken += count
            self.forgotten += count

    def wake(self) -> None:
        """Let the thread that waits in `take` return the records so far."""
        self._asleep = False
        with contextlib.suppress(RuntimeError):  # it rings already
            self._bell.release()

    def take(self, timeout_s: float) -> StructArray:
        """All that wait, in order; none when none came in time. One thread at a time."""
        if self._written == self._taken:
            self._bell.acquire(blocking=False)
            self._asleep = True
            if self._written == self._taken:
                self._bell.acquire(timeout=timeout_s)
            self._asleep = False
        with self._moving:
            stop = self._written
            block = self._copy(self._taken, stop)
            self._taken = stop  # not before: a full ring is written to again from here on
        return block

    def wait_for_room(self, until_s: float) -> None:
        """Until there is room for a quarter of all, or that `time.monotonic`."""
        while self._written - self._taken > 0.75 * self._capacity and time.monotonic() < until_s:
            time.sleep(0.002)

    def _copy(self, start: int, stop: int) -> StructArray:
        first, last = start % self._capacity, stop % self._capacity
        if first < last or start == stop:
            return self._rows[first:last].copy()
        return np.concatenate([self._rows[first:], self._rows[:last]])


_CODES = {"<i8": "q", "<f8": "d", "<i4": "i"}


def _packing(row: np.dtype[Any]) -> struct.Struct:
    """Packs a whole record at once; arrays in it as bytes."""
    fields = [row[name] for name in row.names or ()]
    codes = [f"{field.itemsize}s" if field.shape else _CODES[field.str] for field in fields]
    return struct.Struct("<" + "".join(codes))
