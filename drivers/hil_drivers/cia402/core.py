"""What other threads ask of the cycles: run, enable, move, stop, and take what was recorded."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable

from hil.core import (
    CommandRefused,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StructArray,
)
from hil_drivers.cia402.cycling import Cycling
from hil_drivers.cia402.phases import Phase
from hil_drivers.cia402.player import Track
from hil_drivers.cia402.track import farthest

POLL_S = 0.002
FIRST_ANSWER_S = 2.0
END_S = 3.0
"""Device time for all axes to brake and be off: longer than it takes until those that do not are
taken the voltage from (`braking`) [s]."""
JOIN_S = 1.5

LAST_CYCLES = 3

REST_RAD_S = 0.02
REST_OVER_S = 0.05
REST_WITHIN_S = 2.0
"""An arm is at rest when no joint has moved faster, on average over that time."""


class Core(Cycling):
    """The cyclic exchange of all axes, in a thread of its own; `Cycling` says what it is made of.

    Until `run`, and after `rest`, it only takes what comes (`Cyclic.pump`), so that SDO requests of
    other threads are answered; between them cycles go on, enabled or not.
    """

    @property
    def phase(self) -> Phase:
        """Where the axes are."""
        return self._supervisor.phase

    @property
    def cycle(self) -> int:
        """Number of the last SYNC; −1 before the first."""
        return self._cyclic.cycle

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

    def enable(self, mode: int, within_s: float = 10.0) -> None:
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
        self._wait_for(Phase.ENABLED, within_s, "the axes are not enabled")

    def switch(self, mode: int, within_s: float = 5.0) -> None:
        """Switch the mode of the enabled axes at rest; blocks, raises as `enable`."""
        self._require_bus()
        if self.phase is not Phase.ENABLED:
            raise CommandRefused(f"the mode cannot be switched: the axes are {self.phase.value}")
        self._require_rest()
        self._do(lambda: self._supervisor.switch(mode))
        self._wait_for(Phase.ENABLED, within_s, "the mode is not switched")

    def reset_faults(self, within_s: float = 5.0) -> None:
        """Reset faults that somebody has looked at; blocks, raises as `enable`."""
        self._require_bus()
        if self.phase is not Phase.OFF:
            raise CommandRefused(f"faults cannot be reset: the axes are {self.phase.value}")
        self._problem = ""
        self._do(self._supervisor.reset)
        self._wait_for(Phase.OFF, within_s, "the faults are not reset")

    def disable(self, within_s: float = 5.0) -> None:
        """Switch all axes off, at rest; blocks, raises as `enable`."""
        if self._is_cycling and self.phase is not Phase.OFF:
            self._do(self._supervisor.disable)
            self._wait_for(Phase.OFF, within_s, "the axes are not off")

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

    def mean_torque(self, settle_s: float = 0.2, over_s: float = 0.1) -> list[float]:
        """Measured torques, raw, per axis, of an arm that holds; blocks.

        Args:
            settle_s: Device time to wait before [s].
            over_s: Device time of the mean [s].

        Raises:
            RobotConnectionError: The bus is gone.
        """
        begin = self._cyclic.cycle + round(settle_s / self._period_s)
        end, seen = begin + max(1, round(over_s / self._period_s)), dict[int, list[int]]()

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
        """What ended a motion or enabling, told once; empty when nothing did."""
        problem, self._problem = self._problem, ""
        return problem

    def take(self, timeout_s: float) -> StructArray:
        """All cycle records (`mapping.cycle_dtype`) since the last call, in order, at least one.

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
        # What was told last goes out with the next cycle and is applied in the one after it.
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
