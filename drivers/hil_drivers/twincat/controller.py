"""A PLC that was taken: its variables, the commands to it, the stop, the heartbeat.

`Controller` has three lines to one PLC, because requests on a line wait for each other: one for
everything, one for beats, one for stops. On them:

- `Orders` gives one command at a time. An answer says whose and which command it is to, so that an
  old one, or that of another client, is never taken for it.
- `Stops` counts in `nStop`, where any change is a stop: it needs no order and no answer, and can be
  written by any thread. It looks whether the program shows that it has seen it.
- `Beat` is the heartbeat: as long as it is written, the PLC lets the arm move. It is a thread that
  dies with this process, and is silenced when a stop does not get through.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.arms import Payload, load_arm
from hil.core import CommandRefused, HilError, RobotConnectionError, RobotFault, RobotTimeout
from hil.robot import Identity, Segment
from hil_drivers.twincat.ads import Line
from hil_drivers.twincat.facts import identity_of, require_fit, text
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.reach import address_of
from hil_drivers.twincat.variables import REASONS, Layout, Order, Result, Variables, layout_of

ANSWER_S, BEAT_S, STOP_S = 1.0, 0.2, 0.03
"""How long an answer may take: in general, to a beat, to a stop before it is written again [s]."""

TAKE_S, SURE_S = 3.0, 0.5
"""How long a braking arm is waited for; a client that has died for so much longer than the PLC's
watchdog takes to notice that [s]."""


class Controller:
    """One PLC, from connecting to letting go.

    Args:
        model: Built-in arm.
        options: Of the station.

    Raises:
        RobotConnectionError: No PLC answers, or it is not what the station says.
        PluginError: Its program keeps another contract, or none.
        CommandRefused: Another client has the arm.
        RobotFault: It has a fault that cannot be reset.

    Attributes:
        variables: Of the PLC.
        identity: Who it says to be.
        orders: Commands to it.
        session: Our number.
        stops: To the PLC.
        beat: The heartbeat.
    """

    def __init__(self, model: str, options: Options) -> None:
        arm = load_arm(model)
        layout = layout_of(arm.n_joints)
        self._main, self._beats = Line(options, ANSWER_S), Line(options, BEAT_S)
        self._stopping = Line(options, STOP_S)
        try:
            address = address_of(options)
            for line in (self._main, self._beats, self._stopping):
                line.open(address)
            self.variables = Variables(self._main, layout, options)
            require_fit(self.where, self.info, model, options)
            self.identity: Identity = identity_of(self.info, options, model, self._device())
            self.session = secrets.randbelow(2**32 - 1) + 1
            self.stops = Stops(self.variables, self._stopping)
            self.orders = Orders(
                layout,
                lambda: self.variables.read("stAnswer"),
                self.variables.command,
                self.session,
                arm.joint_names,
            )
            self.beat = self._take(layout.types["stBeat"])
            self.variables.moved = self.beat.hush
        except BaseException:
            self._hang_up()
            raise

    @property
    def where(self) -> str:
        """For messages."""
        return self._main.where

    @property
    def info(self) -> np.void:
        """`stInfo` as it was when we connected."""
        return self.variables.info

    @property
    def watchdog_s(self) -> float:
        """Silence after which the PLC stops the arm [s]."""
        return float(self.info["fWatchdogS"])

    def state(self) -> np.void:
        """`stState`, now; raises as `Line.read`."""
        return self.variables.structure("stState")

    def runtime_state(self) -> int:
        """ADS state of its runtime; raises as `Line.read`."""
        return self._main.state()

    def wait_for(self, timeout_s: float | None = None) -> None:
        """How long answers may take from now on, those to beats and stops left out [s]."""
        self._main.wait_for(ANSWER_S if timeout_s is None else min(timeout_s, ANSWER_S))

    def stop(self) -> None:
        """Tell the PLC to bring the arm to rest, and see that it does; by any thread.

        Raises:
            RobotConnectionError: It could not be told, or does not show that it has seen it; our
                heartbeat has ended then, and its watchdog does it.
        """
        try:
            self.stops.give()
        except HilError as error:
            self.beat.hush()
            raise RobotConnectionError(
                f"{self.where} could not be told to stop: {error.message}; our heartbeat has "
                f"ended, so its watchdog stops the arm within {self.watchdog_s:g} s",
                hint="see to the robot itself, by its emergency stop if need be",
            ) from error

    def load(self, segment: Segment) -> None:
        """Upload set-points and let the PLC check them.

        Raises:
            CommandRefused: There are too many, they leave the limits, or have arrived spoilt.
            RobotError: As `Orders.give`.
        """
        room, rows = int(self.info["nSetPoints"]), len(segment.q)
        if rows > room:
            raise CommandRefused(
                f"segment {segment.index} has {rows} set-points, the PLC has room for {room}",
                hint="plan shorter motions, or raise SET_POINTS in the PLC",
            )
        fields = self.variables.upload(segment)
        what = f"load segment {segment.index} ({segment.kind})"
        answer = self.orders.give(Order.LOAD, what, LOAD_S, **fields)
        if (answer["nSumA"], answer["nSumB"]) != (fields["nSumA"], fields["nSumB"]):
            raise CommandRefused(
                f"{what}: the PLC reads back other set-points than were sent", hint="try again"
            )

    def fault(self, state: np.void) -> str:
        """What the PLC says about its fault."""
        said = text(state["sFault"])
        return f"fault {int(state['nFault'])}" + (f": {said}" if said else "")

    def close(self) -> None:
        """Release the arm and let go of the PLC; raises nothing."""
        with contextlib.suppress(HilError):
            self.orders.give(Order.RELEASE, "release the arm", 0.5)
            self.variables.release()
        self.beat.end()
        self._hang_up()

    def _hang_up(self) -> None:
        for line in (self._stopping, self._beats, self._main):
            line.close()

    def _device(self) -> str:
        try:
            return self._main.device()
        except HilError:
            return "not told"

    def _take(self, kind: np.dtype[np.void]) -> Beat:
        """Take the arm, and begin with the heartbeat."""
        began = time.monotonic()
        while True:
            try:
                self.orders.give(Order.TAKE, "take the arm")
                break
            except CommandRefused:
                held = self.state()["nSession"] != 0
                allowed = self.watchdog_s + SURE_S if held else TAKE_S
                if time.monotonic() - began > allowed:
                    raise
            except RobotFault as error:
                if time.monotonic() - began > TAKE_S:
                    fault = self.fault(self.state())
                    raise RobotFault(f"{self.where}: {fault}", hint=error.hint) from error
            time.sleep(0.05)
        place = self.variables.handle("stBeat")
        beat = Beat(
            lambda session, count: self._beats.write(
                place, np.array([(session, count)], kind).tobytes()
            ),
            self.session,
        )
        beat.start()
        return beat


ORDER_S, LOAD_S = 2.0, 10.0
"""How long the PLC may take; LOAD looks at every set-point, a hundred a cycle [s]."""

POLL_S = 0.002


class Orders:
    """Sends one command at a time.

    Args:
        layout: Of the variables.
        read, write: `stAnswer` and `stCommand`, as bytes.
        session: Our number.
        names: Of the joints, for messages.
    """

    def __init__(
        self,
        layout: Layout,
        read: Callable[[], bytes],
        write: Callable[[bytes], None],
        session: int,
        names: tuple[str, ...],
    ) -> None:
        self._command, self._answer = layout.types["stCommand"], layout.types["stAnswer"]
        self._read, self._write = read, write
        self._session, self._names = session, names
        self._counter = secrets.randbelow(0xFFFFFFFF)

    def give(self, order: Order, what: str, within_s: float = ORDER_S, **fields: Any) -> np.void:
        """Send a command and wait for its answer.

        Args:
            order: What to do.
            what: The same in words, for messages.
            within_s: How long the answer may take.
            fields: Of the command.

        Raises:
            CommandRefused: The PLC says no.
            RobotFault: It has a fault, or has taken the arm away from us.
            RobotTimeout: It has not answered.
            RobotError: The line fails.
        """
        counter = self._counter = self._counter % 0xFFFFFFFF + 1
        command = np.zeros(1, self._command)
        command["nCounter"] = command["nCounterEnd"] = counter
        command["nCommand"], command["nSession"] = order, self._session
        for name, value in fields.items():
            command[name] = value
        self._write(command.tobytes())
        until = time.monotonic() + within_s
        while True:
            answer: np.void = np.frombuffer(self._read(), self._answer)[0]
            if self._is_to(answer, counter, order):
                self._require_done(answer, what)
                return answer
            if time.monotonic() > until:
                raise RobotTimeout(
                    f"the PLC has not answered within {within_s:g} s: {what}",
                    hint="is its program running? TwinCAT shows whether its cycle is",
                )
            time.sleep(POLL_S)

    def _is_to(self, answer: np.void, counter: int, order: Order) -> bool:
        """Whether an answer is whole, and to this command of ours: others count, too."""
        return bool(
            answer["nCounter"] == counter == answer["nCounterEnd"]
            and answer["nSession"] == self._session
            and answer["nCommand"] == order
        )

    def _require_done(self, answer: np.void, what: str) -> None:
        result, where = int(answer["nResult"]), int(answer["nWhere"])
        if result == Result.DONE:
            return
        joint = f" ({self._names[where]})" if 0 <= where < len(self._names) else ""
        why = REASONS.get(result, f"result {result}")
        said = f"the PLC refuses to {what}: {why}{joint}"
        if result in (Result.FAULT, Result.NOT_YOURS):
            raise RobotFault(said, hint="remove the cause, then connect() again")
        hints: dict[int, str] = {
            Result.HELD: "end the other client, or wait until the PLC's watchdog has noticed",
            Result.CHECKSUM: "try again; if it stays so, see to the connection",
            Result.BUSY: "read until it rests",
            Result.STOPPED: "prepare it again; something else may write nStop as well",
        }
        raise CommandRefused(said, hint=hints.get(result, "plan again for this arm"))


def payload_in(answer: np.void) -> Payload:
    """The load that an answer says the PLC computes with."""
    x, y, z = answer["aCom"].tolist()
    xx, yy, zz, xy, xz, yz = answer["aInertia"].tolist()
    return Payload(float(answer["fMass"]), (x, y, z), (xx, yy, zz, xy, xz, yz))


WRITTEN_WITHIN_S, SEEN_WITHIN_S = 0.05, 0.09
"""Until when a stop is written again, and until when the PLC has to show that it has seen it,
counted from the call [s]."""

STOP_MODULO = 2**32


class Stops:
    """Counts in `nStop`, where any change is a stop.

    Args:
        variables: Of the PLC.
        line: To write and look on.
    """

    def __init__(self, variables: Variables, line: Line) -> None:
        self._variables, self._line = variables, line
        self._last = int(variables.structure("nStop"))
        self._given = self._under_way = 0
        self._counting, self._writing = threading.Lock(), threading.Lock()

    def before_start(self) -> tuple[np.void, int]:
        """`stState`, and the `nStop` with which a start is obeyed, whichever client wrote it."""
        with self._counting:
            given, under_way = self._given, self._under_way
        state = self._variables.structure("stState")
        seen = int(state["nStop"])
        with self._counting:
            # Never back behind a stop of ours: the next one would be no change.
            if given == self._given and not under_way:
                self._last = seen
        return state, seen

    def give(self) -> None:
        """Write one, and wait until the PLC shows that its program has seen it; by any thread.

        Raises:
            RobotTimeout: It does not show that.
            RobotError: It could not be written.
        """
        began = time.monotonic()
        with self._counting:
            value = self._last = (self._last + 1) % STOP_MODULO
            self._given += 1
            self._under_way += 1
        try:
            _until(began + WRITTEN_WITHIN_S, self._write)
            _until(began + SEEN_WITHIN_S, lambda: self._require_seen(value))
        finally:
            with self._counting:
                self._under_way -= 1

    def _write(self) -> None:
        """One thread after the other, and the newest number: `nStop` never goes back."""
        with self._writing:
            number = self._last.to_bytes(4, "little")
            self._line.write(self._variables.handle("nStop"), number)

    def _require_seen(self, value: int) -> None:
        """The PLC shows this stop, or one that another thread has given since."""
        seen = int(self._variables.structure("stState", self._line)["nStop"])
        if (self._last - seen) % STOP_MODULO > (self._last - value) % STOP_MODULO:
            raise RobotTimeout(
                f"its program shows stop {seen}, not {value}",
                hint="stop the arm by its own means, then look at the PLC program",
            )


def _until(until: float, act: Callable[[], None]) -> None:
    """Threads share the line, which may refuse one of them: try again."""
    while True:
        try:
            return act()
        except HilError:
            if time.monotonic() >= until:
                raise
        time.sleep(0.001)


EVERY_S = 0.04


class Beat:
    """A thread that writes a counter; it dies with this process, and the PLC notices.

    Args:
        write: Writes session and count.
        session: Our number.

    Attributes:
        problem: What went wrong with the last beat that did; the PLC stops the arm without them.
    """

    def __init__(self, write: Callable[[int, int], None], session: int) -> None:
        self._write, self._session = write, session
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._count = 0
        self.problem: HilError | None = None

    def start(self) -> None:
        """Go on writing."""
        self._thread = threading.Thread(target=self._run, name="beat to the PLC", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether it goes on."""
        return self._thread is not None and self._thread.is_alive() and not self._over.is_set()

    def hush(self) -> None:
        """Fall silent, without waiting for a beat that is on its way."""
        self._over.set()

    def end(self) -> None:
        """Fall silent; idempotent."""
        self.hush()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def _run(self) -> None:
        while not self._over.is_set():
            self._count = self._count % 0xFFFFFFFF + 1
            try:
                self._write(self._session, self._count)
            except HilError as error:
                if self._over.is_set():
                    return
                self.problem = error
                if not isinstance(error, TimeoutError):
                    return
                # It may answer again, or be less busy; whether that is too late, the PLC decides.
            self._over.wait(EVERY_S)
