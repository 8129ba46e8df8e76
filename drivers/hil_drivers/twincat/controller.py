"""The connection to one PLC: taking the arm, commands, stop and heartbeat.

`Controller` refuses a PLC that is not what the station says, then takes the arm. It has three lines
to the PLC, because requests on a line wait for each other: one for beats, one for stops, one for
everything else. On them:

- `Orders` gives one command at a time. An answer names its client and its command, so that an old
  answer, or one to another client, is never mistaken for it.
- `Stops` counts up `nStop`, where any change is a stop: it needs no command and no answer, and any
  thread may write it. It waits until the PLC's program shows that it has seen the stop.
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
from hil_drivers.network import is_ip, once_listening
from hil_drivers.twincat.ads import Line, listening_address
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.variables import (
    CONTRACT,
    CURRENT,
    REASONS,
    TORQUE,
    Layout,
    Order,
    Result,
    Variables,
    layout_of,
)

CYCLE_SHARE = 1e-6
"""Largest difference between the PLC's cycle and the station's, as a share of it."""

EFFORTS = {TORQUE: "torque", CURRENT: "current"}
"""`nEffort` in the words of the option `effort`."""

ANSWER_S, BEAT_S, STOP_S = 1.0, 0.2, 0.03
"""How long an answer may take: in general, to a beat, to a stop before it is written again [s]."""

TAKE_S, SURE_S = 3.0, 0.5
"""How long a braking arm is waited for; a client that has died for so much longer than the PLC's
watchdog takes to notice that [s]."""


class Controller:
    """One PLC, from connecting to closing.

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
        identity: Of arm and PLC, as the PLC states it.
        session: Number of this connection.
        orders: Give commands.
        stops: Give stops.
        beat: The heartbeat.
    """

    def __init__(self, model: str, options: Options) -> None:
        arm = load_arm(model)
        layout = layout_of(arm.n_joints)
        self._main, self._beats = Line(options, ANSWER_S), Line(options, BEAT_S)
        self._stopping = Line(options, STOP_S)
        try:
            # Looked for once and before any line is open: a PLC may drop an older connection from
            # this computer. A mock that is still starting here is waited for.
            host, _ = options.host
            if is_ip(host):
                address = once_listening(host, lambda: listening_address(options))
            else:
                address = listening_address(options)
            for line in (self._main, self._beats, self._stopping):
                line.open(address)
            self.variables = Variables(self._main, layout, options)
            self._require_fit(model, options)
            self.identity = self._identity(model, options)
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
            self.variables.moved = self.beat.silence
        except BaseException:
            self._close_lines()
            raise

    @property
    def where(self) -> str:
        """The PLC, for messages."""
        return self._main.where

    @property
    def info(self) -> np.void:
        """`stInfo` as it was at connecting."""
        return self.variables.info

    @property
    def watchdog_s(self) -> float:
        """Silence after which the PLC stops the arm [s]."""
        return float(self.info["fWatchdogS"])

    def state(self) -> np.void:
        """Read `stState`; raises as `Line.read`."""
        return self.variables.structure("stState")

    def runtime_state(self) -> int:
        """Read the ADS state of the PLC's runtime; raises as `Line.read`."""
        return self._main.state()

    def wait_for(self, timeout_s: float | None = None) -> None:
        """Set how long answers may take, those to beats and stops left out [s]."""
        self._main.wait_for(ANSWER_S if timeout_s is None else min(timeout_s, ANSWER_S))

    def stop(self) -> None:
        """Let the PLC bring the arm to rest; any thread may call this.

        Raises:
            RobotConnectionError: The PLC was not reached, or does not show that it has seen the
                stop; the heartbeat has ended then, so that the PLC's watchdog stops the arm.
        """
        try:
            self.stops.give()
        except HilError as error:
            self.beat.silence()
            raise RobotConnectionError(
                f"{self.where} could not be told to stop: {error.message}; our heartbeat has "
                f"ended, so its watchdog stops the arm within {self.watchdog_s:g} s",
                hint="see to the robot itself, by its emergency stop if need be",
            ) from error

    def load(self, segment: Segment) -> None:
        """Upload set-points and let the PLC check them.

        Raises:
            CommandRefused: There are too many, they leave the limits, or were changed on the way.
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
        """Return number and text of the PLC's fault, as `stState` has them."""
        description = _text(state["sFault"])
        return f"fault {int(state['nFault'])}" + (f": {description}" if description else "")

    def close(self) -> None:
        """Release the arm and close the connection; raises nothing."""
        with contextlib.suppress(HilError):
            self.orders.give(Order.RELEASE, "release the arm", 0.5)
            self.variables.release()
        self.beat.end()
        self._close_lines()

    def _close_lines(self) -> None:
        for line in (self._stopping, self._beats, self._main):
            line.close()

    def _require_fit(self, model: str, options: Options) -> None:
        """Raise if the PLC is not what the station says; all differences are listed.

        Raises:
            RobotConnectionError: Model, axes, cycle or effort differ.
        """
        info, described = self.info, load_arm(model)
        plc_model, cycle = _text(info["sModel"]), float(info["fCycleS"])
        problems = []
        if info["nAxes"] != described.n_joints:
            problems.append(f"it has {info['nAxes']} axes, the {model} has {described.n_joints}")
        if plc_model and plc_model != model:
            problems.append(f"it moves a {plc_model}, the station says {model}")
        if not abs(cycle * options.rate_hz - 1) < CYCLE_SHARE:
            wanted = 1e3 / options.rate_hz
            problems.append(f"its cycle is {cycle * 1e3:g} ms, rate_hz says {wanted:g}")
        effort = EFFORTS.get(int(info["nEffort"]), f"effort {info['nEffort']}")
        if effort != options.effort:
            problems.append(f"it tells {effort}, option effort says {options.effort}")
        if not (info["aQMin"] < info["aQMax"]).all() or not (info["aQdMax"] > 0).all():
            problems.append("its joint limits are none")
        if problems:
            raise RobotConnectionError(
                f"{self.where}: {'; '.join(problems)}", hint="mend the station, or the PLC's GVL"
            )

    def _identity(self, model: str, options: Options) -> Identity:
        info = self.info
        try:
            device = self._main.device()
        except HilError:
            device = "not told"
        return Identity(
            model=_text(info["sModel"]) or model,
            serial=_text(info["sSerial"]),
            firmware=_text(info["sProgram"]),
            driver="twincat",
            details={
                "ams": f"{options.ams_net_id}:{options.port}",
                "runtime": device,
                "contract": str(CONTRACT),
                "effort": options.effort,
                "cycle_s": f"{float(info['fCycleS']):g}",
                "ring_rows": str(int(info["nRingRows"])),
                "set_points": str(int(info["nSetPoints"])),
                "watchdog_s": f"{float(info['fWatchdogS']):g}",
                "stop_rad_s2": f"{float(info['fStopRadS2']):g}",
            },
        )

    def _take(self, kind: np.dtype[np.void]) -> Beat:
        """Take the arm and start the heartbeat.

        Args:
            kind: dtype of `stBeat`.
        """
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


def _text(raw: bytes) -> str:
    return bytes(raw).split(b"\0")[0].decode("windows-1252")


ORDER_S, LOAD_S = 2.0, 10.0
"""How long the PLC may take; LOAD looks at every set-point, a hundred a cycle [s]."""

POLL_S = 0.002


class Orders:
    """Gives one command at a time and waits for its answer.

    Args:
        layout: Of the variables.
        read: Returns the bytes of `stAnswer`.
        write: Writes the bytes of `stCommand`.
        session: Number of this connection.
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
            order: The command.
            what: The command in words, for messages.
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
        """Return whether an answer is whole and to this command: other clients count, too."""
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
        message = f"the PLC refuses to {what}: {why}{joint}"
        if result in (Result.FAULT, Result.NOT_YOURS):
            raise RobotFault(message, hint="remove the cause, then connect() again")
        hints: dict[int, str] = {
            Result.HELD: "end the other client, or wait until the PLC's watchdog has noticed",
            Result.CHECKSUM: "try again; if it stays so, see to the connection",
            Result.BUSY: "read until it rests",
            Result.STOPPED: "prepare it again; something else may write nStop as well",
        }
        raise CommandRefused(message, hint=hints.get(result, "plan again for this arm"))


def payload_in(answer: np.void) -> Payload:
    """Return the load that the PLC computes with, as `stAnswer` has it."""
    x, y, z = answer["aCom"].tolist()
    xx, yy, zz, xy, xz, yz = answer["aInertia"].tolist()
    return Payload(float(answer["fMass"]), (x, y, z), (xx, yy, zz, xy, xz, yz))


WRITTEN_WITHIN_S, SEEN_WITHIN_S = 0.05, 0.09
"""Until when a stop is written again, and until when the PLC has to show that it has seen it,
counted from the call [s]."""

STOP_MODULO = 2**32


class Stops:
    """Gives stops by counting up `nStop`.

    Args:
        variables: Of the PLC.
        line: For stops only.
    """

    def __init__(self, variables: Variables, line: Line) -> None:
        self._variables, self._line = variables, line
        self._last = int(variables.structure("nStop"))
        self._given = self._under_way = 0
        self._counting, self._writing = threading.Lock(), threading.Lock()

    def before_start(self) -> tuple[np.void, int]:
        """Return `stState`, and the `nStop` with which a start will be obeyed."""
        with self._counting:
            given, under_way = self._given, self._under_way
        state = self._variables.structure("stState")
        seen = int(state["nStop"])  # other clients count it up, too
        with self._counting:
            # Never back behind a stop of this client: the next one would be no change.
            if given == self._given and not under_way:
                self._last = seen
        return state, seen

    def give(self) -> None:
        """Write a stop and wait until the PLC's program has seen it; any thread may call this.

        Raises:
            RobotTimeout: The program does not show the stop in time.
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
        """Write the newest number, one thread after the other, so that `nStop` never goes back."""
        with self._writing:
            number = self._last.to_bytes(4, "little")
            self._line.write(self._variables.handle("nStop"), number)

    def _require_seen(self, value: int) -> None:
        """Raise unless the PLC shows this stop, or a later one of another thread."""
        seen = int(self._variables.structure("stState", self._line)["nStop"])
        if (self._last - seen) % STOP_MODULO > (self._last - value) % STOP_MODULO:
            raise RobotTimeout(
                f"its program shows stop {seen}, not {value}",
                hint="stop the arm by its own means, then look at the PLC program",
            )


def _until(until: float, act: Callable[[], None]) -> None:
    """Call `act` until it raises nothing: threads share the line, which may refuse one of them."""
    while True:
        try:
            return act()
        except HilError:
            if time.monotonic() >= until:
                raise
        time.sleep(0.001)


EVERY_S = 0.04
"""Time between two beats [s]."""


class Beat:
    """The heartbeat: a thread that writes a counter. It dies with this process, the PLC notices.

    Args:
        write: Writes session and count.
        session: Number of this connection.

    Attributes:
        problem: Error of the last beat that failed; the PLC stops the arm if beats stay away.
    """

    def __init__(self, write: Callable[[int, int], None], session: int) -> None:
        self._write, self._session = write, session
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._count = 0
        self.problem: HilError | None = None

    def start(self) -> None:
        """Begin to write, until `silence` or `end`."""
        self._thread = threading.Thread(target=self._run, name="beat to the PLC", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether beats are being written."""
        return self._thread is not None and self._thread.is_alive() and not self._over.is_set()

    def silence(self) -> None:
        """Write no further beats, without waiting for one that is on its way."""
        self._over.set()

    def end(self) -> None:
        """Write no further beats and wait for the thread; idempotent."""
        self.silence()
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
