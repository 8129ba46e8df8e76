"""Connection to one PLC, for control of the arm, commands, stops and heartbeat.

`Controller` rejects a PLC that does not match the station, then takes control of the arm. Requests
on one line are executed one after the other. The controller therefore opens three separate lines to
the PLC: for the heartbeat, for stops, and for all other requests. Three classes use the lines to
the PLC:

- `Orders` sends commands, one at a time. An answer contains the session and the number of its
  command, so that an old answer, or an answer to another client, is never accepted.
- `Stops` increments `nStop`; every change of `nStop` is a stop. A stop needs no command and no
  answer, and any thread can write `nStop`. After writing, `Stops` waits until the PLC's program
  shows the new value.
- `Beat` writes the heartbeat: the PLC lets the arm move only while the heartbeat is written. The
  heartbeat ends with this process, and also if a stop does not reach the PLC.
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
"""Maximum relative difference between the cycle times of the PLC and of the station."""

EFFORTS = {TORQUE: "torque", CURRENT: "current"}
"""Dictionary from the value of `nEffort` to the value of the option `effort`."""

ANSWER_S, BEAT_S, STOP_S = 1.0, 0.2, 0.03
"""Time-outs of answers [s]: in general, to a heartbeat, and to a stop before its repetition."""

TAKE_S, SURE_S = 3.0, 0.5
"""Two time-outs for taking control of the arm [s].

Of the two time-outs, the first is the longest wait for an arm that is braking. The second time-out,
plus the watchdog time of the PLC, is the longest wait until the PLC detects the death of an earlier
client.
"""


class Controller:
    """Connection to one PLC, which exists from connecting to closing.

    Args:
        model: Name of a built-in arm.
        options: Options of the station.

    Raises:
        RobotConnectionError: No PLC answers, or the PLC does not match the station.
        PluginError: The PLC's program implements a different version of the contract, or no
            contract.
        CommandRefused: Another client controls the arm.
        RobotFault: The PLC reports a fault that cannot be reset.

    Attributes:
        variables: Access to the variables of the PLC.
        identity: Identity of arm and PLC, as reported by the PLC.
        session: Number that identifies this connection in the PLC.
        orders: Sender of commands.
        stops: Sender of stops.
        beat: Heartbeat.
    """

    def __init__(self, model: str, options: Options) -> None:
        arm = load_arm(model)
        layout = layout_of(arm.n_joints)
        self._main, self._beats = Line(options, ANSWER_S), Line(options, BEAT_S)
        self._stopping = Line(options, STOP_S)
        try:
            # Find the address once and before any line is open, because a PLC can drop an older
            # connection from this computer. Wait for a mock that is still starting here.
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
        """Name of the PLC for messages."""
        return self._main.where

    @property
    def info(self) -> np.void:
        """Structure `stInfo` as read when connecting."""
        return self.variables.info

    @property
    def watchdog_s(self) -> float:
        """Time without a heartbeat after which the PLC stops the arm [s]."""
        return float(self.info["fWatchdogS"])

    def state(self) -> np.void:
        """Read the variable `stState`; raise the same exceptions as `Line.read`."""
        return self.variables.structure("stState")

    def runtime_state(self) -> int:
        """Read the ADS state of the PLC's runtime; raise the same exceptions as `Line.read`."""
        return self._main.state()

    def wait_for(self, timeout_s: float | None = None) -> None:
        """Set the time-out of answers [s], except that of answers to heartbeats and stops."""
        self._main.wait_for(ANSWER_S if timeout_s is None else min(timeout_s, ANSWER_S))

    def stop(self) -> None:
        """Command the PLC to bring the arm to rest; any thread can call this.

        Raises:
            RobotConnectionError: The PLC was not reached, or the PLC's program does not show the
                stop. If the stop fails in this way, the heartbeat was ended, so that the PLC's
                watchdog stops the arm.
        """
        try:
            self.stops.give()
        except HilError as error:
            self.beat.silence()
            raise RobotConnectionError(
                f"{self.where} did not confirm the stop: {error.message}; the heartbeat has ended, "
                f"so that the PLC's watchdog stops the arm within {self.watchdog_s:g} s",
                hint="check that the robot stops; if not, press its emergency stop",
            ) from error

    def load(self, segment: Segment) -> None:
        """Upload the set-points of a segment, and command the PLC to check these set-points.

        Raises:
            CommandRefused: The segment has too many set-points, the set-points leave the limits, or
                the set-points were changed during the transfer.
            RobotError: The command failed; see `Orders.give`.
        """
        room, rows = int(self.info["nSetPoints"]), len(segment.q)
        if rows > room:
            raise CommandRefused(
                f"segment {segment.index} has {rows} set-points, the PLC stores at most {room}",
                hint="plan shorter motions, or raise SET_POINTS in the PLC",
            )
        fields = self.variables.upload(segment)
        what = f"load segment {segment.index} ({segment.kind})"
        answer = self.orders.give(Order.LOAD, what, LOAD_S, **fields)
        if (answer["nSumA"], answer["nSumB"]) != (fields["nSumA"], fields["nSumB"]):
            raise CommandRefused(
                f"{what}: the set-points read back from the PLC differ from those sent",
                hint="try again",
            )

    def fault(self, state: np.void) -> str:
        """Return the number and the text of the PLC's fault, as reported in `stState`."""
        description = _text(state["sFault"])
        return f"fault {int(state['nFault'])}" + (f": {description}" if description else "")

    def close(self) -> None:
        """Release the arm and close the connection; never raise."""
        with contextlib.suppress(HilError):
            self.orders.give(Order.RELEASE, "release the arm", 0.5)
            self.variables.release()
        self.beat.end()
        self._close_lines()

    def _close_lines(self) -> None:
        for line in (self._stopping, self._beats, self._main):
            line.close()

    def _require_fit(self, model: str, options: Options) -> None:
        """Raise if the PLC does not match the station; the message lists all differences.

        Raises:
            RobotConnectionError: Model, number of axes, cycle time or effort of PLC and station
                differ.
        """
        info, described = self.info, load_arm(model)
        plc_model, cycle = _text(info["sModel"]), float(info["fCycleS"])
        problems = []
        if info["nAxes"] != described.n_joints:
            problems.append(f"it has {info['nAxes']} axes, {model} has {described.n_joints}")
        if plc_model and plc_model != model:
            problems.append(f"its arm is {plc_model}, the station has {model}")
        if not abs(cycle * options.rate_hz - 1) < CYCLE_SHARE:
            period_ms = 1e3 / options.rate_hz
            problems.append(f"its cycle is {cycle * 1e3:g} ms, rate_hz is for {period_ms:g} ms")
        effort = EFFORTS.get(int(info["nEffort"]), f"effort {info['nEffort']}")
        if effort != options.effort:
            problems.append(f"it reports {effort}, the option effort is {options.effort}")
        if not (info["aQMin"] < info["aQMax"]).all() or not (info["aQdMax"] > 0).all():
            problems.append("its joint limits are invalid")
        if problems:
            raise RobotConnectionError(
                f"{self.where}: {'; '.join(problems)}",
                hint="correct the station, or the GVL of the PLC",
            )

    def _identity(self, model: str, options: Options) -> Identity:
        info = self.info
        try:
            device = self._main.device()
        except HilError:
            device = "not reported"
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
        """Take control of the arm and start the heartbeat.

        Args:
            kind: NumPy dtype of the variable `stBeat`.
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
"""Time-outs of commands [s]: for all commands except LOAD, and for LOAD.

For the command LOAD the PLC checks every set-point, 100 of them per cycle.
"""

POLL_S = 0.002


class Orders:
    """Sender of commands, which sends one command at a time and waits for the answer.

    Args:
        layout: Layouts of the PLC's variables.
        read: Function that returns the bytes of `stAnswer`.
        write: Function that writes the bytes of `stCommand`.
        session: Number that identifies this connection in the PLC.
        names: Names of the joints, used in messages.
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
            order: Command to send.
            what: Description of the command, for messages.
            within_s: Longest wait for the answer [s].
            fields: Values of the fields of `stCommand`.

        Raises:
            CommandRefused: The PLC refuses the command.
            RobotFault: The PLC has a fault, or has ended this client's control of the arm.
            RobotTimeout: The PLC has not answered the command in time.
            RobotError: The request on the line failed.
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
                    hint="check in TwinCAT that the PLC program and its task run",
                )
            time.sleep(POLL_S)

    def _is_to(self, answer: np.void, counter: int, order: Order) -> bool:
        """Return whether an answer is complete and belongs to this command of this client."""
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
            Result.HELD: "end the other client, or wait until the PLC's watchdog releases the arm",
            Result.CHECKSUM: "try again; if the error remains, check the connection",
            Result.BUSY: "read until the arm is at standstill",
            Result.STOPPED: "prepare the segment again; check whether another program writes nStop",
        }
        raise CommandRefused(message, hint=hints.get(result, "plan again for this arm"))


def payload_in(answer: np.void) -> Payload:
    """Return the payload that the PLC uses, as reported in `stAnswer`."""
    x, y, z = answer["aCom"].tolist()
    xx, yy, zz, xy, xz, yz = answer["aInertia"].tolist()
    return Payload(float(answer["fMass"]), (x, y, z), (xx, yy, zz, xy, xz, yz))


WRITTEN_WITHIN_S, SEEN_WITHIN_S = 0.05, 0.09
"""Time limits of a stop from the call on [s]: for writing, and until the PLC shows the stop."""

STOP_MODULO = 2**32


class Stops:
    """Sender of stops, each of which increments `nStop`.

    Args:
        variables: Variables of the PLC.
        line: Line to the PLC that is used for stops only.
    """

    def __init__(self, variables: Variables, line: Line) -> None:
        self._variables, self._line = variables, line
        self._last = int(variables.structure("nStop"))
        self._given = self._under_way = 0
        self._counting, self._writing = threading.Lock(), threading.Lock()

    def before_start(self) -> tuple[np.void, int]:
        """Return `stState` and the value of `nStop` that a start command must contain."""
        with self._counting:
            given, under_way = self._given, self._under_way
        state = self._variables.structure("stState")
        seen = int(state["nStop"])  # other clients increment it, too
        with self._counting:
            # Never go back behind a stop of this client, else the next stop changes nothing.
            if given == self._given and not under_way:
                self._last = seen
        return state, seen

    def give(self) -> None:
        """Write a stop and wait until the PLC's program shows the stop; any thread can call this.

        Raises:
            RobotTimeout: The program of the PLC does not show the stop in time.
            RobotError: The stop could not be written to the PLC.
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
        """Write the newest `nStop`, one thread at a time, so that the value never decreases."""
        with self._writing:
            number = self._last.to_bytes(4, "little")
            self._line.write(self._variables.handle("nStop"), number)

    def _require_seen(self, value: int) -> None:
        """Raise unless the PLC shows this value of `nStop`, or a later stop of another thread."""
        seen = int(self._variables.structure("stState", self._line)["nStop"])
        if (self._last - seen) % STOP_MODULO > (self._last - value) % STOP_MODULO:
            raise RobotTimeout(
                f"its program shows stop number {seen}, not {value}",
                hint="stop the arm at the robot itself, then check the PLC program",
            )


def _until(until: float, act: Callable[[], None]) -> None:
    """Call `act` until the call succeeds or the time is over; a call fails if a line is busy."""
    while True:
        try:
            return act()
        except HilError:
            if time.monotonic() >= until:
                raise
        time.sleep(0.001)


EVERY_S = 0.04
"""Period of the heartbeat [s]."""


class Beat:
    """Heartbeat thread that writes a counter, so that the PLC detects the end of this process.

    Args:
        write: Function that writes the session number and the count to the PLC.
        session: Number that identifies this connection in the PLC.

    Attributes:
        problem: Exception of the last heartbeat that failed. The PLC stops the arm if heartbeats
            are missing.
    """

    def __init__(self, write: Callable[[int, int], None], session: int) -> None:
        self._write, self._session = write, session
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._count = 0
        self.problem: HilError | None = None

    def start(self) -> None:
        """Start the heartbeat, which runs until `silence` or `end` is called."""
        self._thread = threading.Thread(target=self._run, name="beat to the PLC", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the heartbeat thread still writes the heartbeat."""
        return self._thread is not None and self._thread.is_alive() and not self._over.is_set()

    def silence(self) -> None:
        """Stop the heartbeat without waiting for a write in progress."""
        self._over.set()

    def end(self) -> None:
        """Stop the heartbeat and wait for its thread; further calls have no effect."""
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
                # The PLC possibly answers again; its watchdog decides whether that is too late.
            self._over.wait(EVERY_S)
