"""The thread that owns the bus: cycles at their time, answers judged, set-points sent, all kept."""

from __future__ import annotations

import contextlib
import gc
import math
import threading
import time
from collections import deque
from collections.abc import Callable

from hil.core import RobotConnectionError
from hil_drivers.cia402.contracts import Cyclic, Inputs, Outputs
from hil_drivers.cia402.mapping import LATE, STALLED, Mapping
from hil_drivers.cia402.options import LATE_CYCLES_SIMULATED
from hil_drivers.cia402.phases import Phase
from hil_drivers.cia402.player import Player
from hil_drivers.cia402.realtime import realtime
from hil_drivers.cia402.ring import Ring
from hil_drivers.cia402.schedule import Schedule
from hil_drivers.cia402.stalls import TOLD_AFTER_S, Stalls
from hil_drivers.cia402.supervisor import Supervisor

KEPT_S = 60.0
"""Device time of records that may wait to be taken [s]."""

BATCH_S = 0.016
"""Wall time of records that are handed over together, so that one wake-up serves several [s]."""

FREE_BATCH = 16
STOP_RAD_S2 = 8.0
PUMP_S = 0.02
CLEAN_UP_S = 5.0
LAST_WORDS_S = 0.002


class Cycling:
    """The cyclic exchange of all axes, as a thread of its own does it.

    Args:
        cyclic: The drives.
        supervisor, player: Write to `outputs`.
        outputs: What the drives are told.
        schedule: When cycles begin.
        mapping: Of every axis.
        period_s: Device time of a cycle [s].
        wall_period_s: Wall time of a cycle; 0 when cycles have no deadlines [s].
        kept_s: Device time of records that may wait to be taken [s].
        late_cycles: Periods without a SYNC after which a motion is not gone on with.
        stop_rad_s2: How it is ended then.

    Attributes:
        temperature: (n,) [°C], written by whoever asks the drives for it; goes into every record.
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
    ) -> None:
        n = len(outputs.controlword)
        self._cyclic, self._supervisor, self._player = cyclic, supervisor, player
        self._outputs, self.schedule = outputs, schedule
        self._period_s, self._free = period_s, wall_period_s <= 0.0
        self._slower = wall_period_s / period_s  # than the time of the drives
        batch = FREE_BATCH if self._free else max(1, math.ceil(BATCH_S / wall_period_s))
        self.ring = Ring(mapping, n, max(64, round(kept_s / period_s)), batch)
        self.temperature = self.ring.temperature
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
        except Exception as error:  # nobody would ever hear of it in this thread
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
        # Without deadlines nothing is late, and whoever never sleeps must not keep others waiting.
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
        told = outputs.segment, outputs.status
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
        self._keep(told, flags)
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
        """Records of an arm at rest may go; those of a motion that nobody takes end it."""
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
        """Collect young garbage now and then, as nobody else does while cycles go on."""
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
