"""Real-Time Data Exchange: a lossless client for the state that a UR controller sends.

`ur-rtde`, which moves the arm, keeps the latest state only and drops what came before it; a
recording needs every one. The way of a data package, from the outside in:

- `Receiver` is what the driver uses: connect, take rows, close.
- `Stream` is its thread. It reads the socket as soon as something is there and keeps the packages
  in a bounded queue until they are taken. If nothing takes them, it stops reading: first the
  kernel waits, then the controller, and at last it is an error. Nothing is dropped unnoticed.
- `Cutter` cuts the byte stream into packages and checks their time stamps for gaps.
- `Conversation` agrees with the controller on the outputs to be sent (`Agreement`). Outputs that
  a controller does not know, by series or software, are left out. Text messages may come between
  any question and its answer.
- `Layout` turns packages into rows, many at once, by swapping runs of one width to this machine's
  byte order.
- `FIELDS` lists the recorded outputs.

Every package is `size` (u16, all bytes of it), `kind` (u8) and content, in network byte order.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import groupby
from types import TracebackType
from typing import Any, Literal

import numpy as np

from hil.core import RobotConnectionError, RobotTimeout, StructArray
from hil_drivers.network import mock_first

RTDE_PORT = 30004
STEP_S = 2.0
SILENCE_S = 2.0
CAPACITY_S = 60.0
KEPT_TEXTS = 200


class Receiver:
    """Listens to one controller and commands nothing; any number of clients may.

    Args:
        host: Address of the controller.
        frequency_hz: States per second; None for all there are (125 on CB3, 500 on e-Series).
        port: Of the RTDE server.
        step_s: How long connecting and each step of the handshake may take [s].
        silence_s: Without a state for so long, the connection counts as lost [s].
        capacity_s: How much may wait to be taken, by the robot's clock [s]; then the kernel and
            the controller wait, and after two more seconds it is an error.

    Attributes:
        messages: What the controller said in words; the oldest are forgotten.
    """

    def __init__(
        self,
        host: str,
        frequency_hz: float | None = None,
        port: int = RTDE_PORT,
        *,
        step_s: float = STEP_S,
        silence_s: float = SILENCE_S,
        capacity_s: float = CAPACITY_S,
    ) -> None:
        self._address, self._peer = (host, port), f"{host}:{port}"
        self._asked_hz, self._step_s = frequency_hz, step_s
        self._silence_s, self._capacity_s = silence_s, capacity_s
        self._opening = threading.Lock()
        self._shaking: socket.socket | None = None
        self._closed = threading.Event()
        self._agreement: Agreement | None = None
        self._stream: Stream | None = None
        self.messages: deque[TextMessage] = deque(maxlen=KEPT_TEXTS)

    @property
    def version(self) -> Version:
        """Of the controller's software: major, minor, bug-fix, build."""
        return self._agreed.version

    @property
    def frequency_hz(self) -> float:
        """States per second."""
        return self._agreed.frequency_hz

    @property
    def missing(self) -> Mapping[str, str]:
        """Outputs that this controller does not send → why not."""
        return self._agreed.missing

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the rows: `host_time` and the RTDE outputs by their names."""
        return self._agreed.layout.dtype

    @property
    def counts(self) -> Counts:
        """Counts since `open`."""
        return self._stream.counts if self._stream else Counts()

    @property
    def alive(self) -> bool:
        """Whether states may still come."""
        return self._stream is not None and self._stream.alive

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced [s].

        A state that is repeated is no news; infinite when not connected.
        """
        return self._stream.age_s if self._stream and self._stream.alive else math.inf

    @property
    def newest(self) -> StructArray | None:
        """The newest row, shape (1,), whether it was taken or not; None before the first."""
        return self._stream.newest if self._stream else None

    def open(self) -> None:
        """Connect, agree on the outputs, and start; does nothing while connected.

        Raises:
            RobotConnectionError: Nobody there, or no RTDE server, or it refuses; or `close` came
                from another thread meanwhile.
        """
        with self._opening:
            if self.alive:
                return
            self._end_stream()
            self._closed.clear()
            line = self._connect()
            try:
                self._shaking = line
                talk = Conversation(line, self._peer, self._step_s, self.messages.append)
                self._agreement = talk.agree(self._asked_hz)
                talk.start()
                if self._closed.is_set():
                    raise self._not_open()
            except BaseException:
                line.close()
                raise
            finally:
                self._shaking = None
            self._stream = Stream(
                line,
                self._peer,
                self._agreement,
                self._silence_s,
                self._capacity_s,
                self.messages,
            )
            if self._closed.is_set():
                self._end_stream()

    def keep(self, seconds: float | None, *, forgiving: bool = False) -> None:
        """Set the age beyond which waiting rows are dropped, by the robot's clock.

        Args:
            seconds: None to lose nothing, as after `open`.
            forgiving: When `capacity_s` wait nevertheless, drop the oldest instead of ending.
        """
        if self._stream is not None:
            rate = self.frequency_hz
            self._stream.forgiving = forgiving
            self._stream.keep = None if seconds is None else max(1, int(seconds * rate))

    def take(self, timeout_s: float = 1.0) -> StructArray:
        """All rows since the last call, in order, at least one; see `dtype`.

        Raises:
            RobotTimeout: None came within `timeout_s`.
            RobotConnectionError: It was never opened, or the connection is gone; what came
                before that was taken by the calls before.
        """
        if self._stream is None:
            raise self._not_open()
        return self._stream.take(timeout_s)

    def close(self) -> None:
        """End the connection; idempotent, for any thread. A waiting `take` raises an error."""
        self._closed.set()
        shaking = self._shaking
        if shaking is not None:
            with contextlib.suppress(OSError):
                shaking.shutdown(socket.SHUT_RDWR)
        self._end_stream()

    def __enter__(self) -> Receiver:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def _agreed(self) -> Agreement:
        if self._agreement is None:
            raise self._not_open()
        return self._agreement

    def _connect(self) -> socket.socket:
        try:
            line = socket.create_connection(self._address, self._step_s)
        except OSError as error:
            raise RobotConnectionError(
                f"no RTDE server answers at {self._peer}: {error.strerror or error}",
                hint=mock_first(self._address[0], "ur")
                + "is the robot on, the cable in, the address right, RTDE not disabled in the "
                "controller's security settings?",
            ) from error
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return line

    def _end_stream(self) -> None:
        if self._stream is not None:
            self._stream.close()

    def _not_open(self) -> RobotConnectionError:
        return RobotConnectionError(
            f"the controller at {self._peer} is not connected", hint="call open() first"
        )


READ_BYTES = 1 << 18

PATIENCE_S = 2.0
"""How long a full queue is waited for; what comes meanwhile stays with the kernel [s]."""

HURRY_S = 1e-3
"""What follows sooner is read together: no robot is so fast, but simulated ones are, and waking up
for each state would cost them more than making it [s]."""

_CLOSED = ("is not listened to any more: its connection was closed", "connect again")
_LOST = "see to the robot: is it on, is the cable in, was it restarted? then connect again"


class Stream:
    """Rows of a started controller, in a bounded queue; without loss, or with an error.

    Args:
        line: Connected and started; this object closes it.
        peer: The address, for messages.
        agreement: With the controller, about its outputs.
        silence_s: Without a data package for so long, the connection counts as lost [s].
        capacity_s: How much waits to be taken at most, by the robot's clock [s].
        texts: Where text messages go; the oldest are forgotten.

    Attributes:
        keep: Most rows that wait to be taken, older ones being dropped; None for all.
        forgiving: Whether the oldest rows are let go when the queue is full and nobody takes any;
            else that is the end of the stream.
    """

    def __init__(
        self,
        line: socket.socket,
        peer: str,
        agreement: Agreement,
        silence_s: float,
        capacity_s: float,
        texts: deque[TextMessage],
    ) -> None:
        self._line, self._peer, self._silence_s = line, peer, silence_s
        self._layout = agreement.layout
        self._cutter = Cutter(agreement.layout, agreement.frequency_hz)
        self._capacity = max(1, int(capacity_s * agreement.frequency_hz))
        self._texts = texts
        self.keep: int | None = None
        self.forgiving = False
        self._queue: deque[tuple[bytes, float, int]] = deque()
        self._waiting = 0
        self._problem: tuple[str, str] | None = None
        self._changed = threading.Condition()
        self._newest: tuple[bytes, float] | None = None
        self._clock = -math.inf
        self._heard = self._read_at = time.monotonic()
        line.settimeout(min(0.25, silence_s / 4))
        self._thread = threading.Thread(target=self._run, name=f"rtde {peer}", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> Counts:
        """Counts so far."""
        return self._cutter.counts

    @property
    def alive(self) -> bool:
        """Whether data packages may still come."""
        return self._problem is None

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced, or since the start [s].

        Packages that repeat one state are no news of the arm.
        """
        return time.monotonic() - self._heard

    @property
    def newest(self) -> StructArray | None:
        """The newest row, shape (1,), taken or not; None before the first one."""
        newest = self._newest
        return None if newest is None else self._layout.rows(*newest)

    def take(self, timeout_s: float) -> StructArray:
        """All rows since the last call, in order, at least one.

        Raises:
            RobotTimeout: None came in time.
            RobotConnectionError: None are left, and none will come any more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._problem, timeout_s)
            pieces, self._waiting = list(self._queue), 0
            self._queue.clear()
            self._changed.notify_all()
        if not pieces:
            raise self._why_nothing(timeout_s)
        counts = [count for _, _, count in pieces]
        host_time = np.repeat([host for _, host, _ in pieces], counts)
        return self._layout.rows(b"".join(data for data, _, _ in pieces), host_time)

    def close(self) -> None:
        """End the connection, from any thread, as often as wanted."""
        self._fail(_CLOSED)
        with contextlib.suppress(OSError):  # it was gone before
            self._line.shutdown(socket.SHUT_RDWR)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _why_nothing(self, timeout_s: float) -> Exception:
        if self._problem is None:
            return RobotTimeout(
                f"the controller at {self._peer} has sent no state for {timeout_s:g} s",
                hint="look at cable, switch and controller",
            )
        what, hint = self._problem
        said = "".join(f"; it said: {text}" for text in list(self._texts)[-2:])
        return RobotConnectionError(f"the controller at {self._peer} {what}{said}", hint=hint)

    def _run(self) -> None:
        try:
            while self._problem is None:
                self._read()
        except OSError as error:
            self._fail((f"broke the connection: {error.strerror or error}", _LOST))
        except Exception as error:  # it would go unnoticed in this thread
            self._fail((f"could not be read: {error!r}", "please report this"))
        finally:
            self._line.close()

    def _read(self) -> None:
        if time.monotonic() - self._read_at < HURRY_S:
            time.sleep(HURRY_S)
        try:
            data = self._line.recv(READ_BYTES)
        except TimeoutError:
            if self.age_s > self._silence_s:
                self._fail((f"has fallen silent for {self.age_s:.1f} s", _LOST))
            return
        host_time, self._read_at = time.time(), time.monotonic()
        if not data:
            half = f" in the middle of a package ({self._cutter.torn} bytes of it)"
            torn = half if self._cutter.torn else ""
            self._fail((f"hung up{torn} after {self.counts.packages} states", _LOST))
            return
        packages = self._cutter.feed(data, host_time)
        self._texts.extend(self._cutter.texts)
        self._cutter.texts.clear()
        if packages:
            self._put(packages, host_time)
        if self.age_s > self._silence_s:
            what = "repeated one state, its clock standing still," if packages else "sent no state"
            self._fail((f"has {what} for {self.age_s:.1f} s", _LOST))
        if self._cutter.problem is not None:
            self._fail(self._cutter.problem)

    def _put(self, packages: bytes, host_time: float) -> None:
        size = self._layout.size
        count = len(packages) // size
        self._newest = (packages[-size:], host_time)
        before, self._clock = self._clock, self._layout.time(packages[-size:])
        goes_on = self._clock > before
        self._heard = time.monotonic() if goes_on else self._heard
        with self._changed:
            # Rows that came are kept even so: the queue may be too long by one reading.
            self._queue.append((packages, host_time, count))
            self._waiting += count
            if self.keep is not None:
                self._let_go_beyond(self.keep)
            self.counts.deepest = max(self.counts.deepest, self._waiting)
            self._changed.notify_all()
            if not self._changed.wait_for(self._has_room, PATIENCE_S):
                self._overflow()
        self._heard = time.monotonic() if goes_on else self._heard

    def _overflow(self) -> None:
        """The queue is full, and stays so."""
        if self.forgiving:
            self._let_go_beyond(self._capacity // 2)
            return
        self._problem = (
            f"was not listened to: {self._waiting} states wait to be taken",
            "hil is held up: look for a busy machine or a slow disk",
        )
        self._changed.notify_all()

    def _let_go_beyond(self, rows: int) -> None:
        while self._queue and self._waiting - self._queue[0][2] >= rows:
            self._waiting -= self._queue.popleft()[2]

    def _has_room(self) -> bool:
        return self._waiting < self._capacity or self._problem is not None

    def _fail(self, problem: tuple[str, str]) -> None:
        """The first problem is the one that explains."""
        with self._changed:
            self._problem = self._problem or problem
            self._changed.notify_all()


BACK_IS_REBOOT_S = 1.0
"""A clock that goes back further than this was started anew [s]."""

LONG_STEP = 1.5
"""Ticks between two states; from here on states are missing."""

NETWORK = "look at cable and switch; connect the robot directly"


@dataclass(slots=True)
class Counts:
    """Counts of rows and packages since the connection was opened.

    Attributes:
        packages: Of data.
        missing: Data packages that are not there, by the time stamps of those around them.
        duplicates: Data packages with the time stamp of the one before.
        texts: Text messages.
        others: Packages of other kinds, which a started controller has no reason to send.
        deepest: Most rows that have waited to be taken.
    """

    packages: int = 0
    missing: int = 0
    duplicates: int = 0
    texts: int = 0
    others: int = 0
    deepest: int = 0


class Cutter:
    """Cuts the bytes of a socket into whole packages.

    Args:
        layout: Of the data packages.
        frequency_hz: How many of them there should be in a second.

    Attributes:
        counts: See `Counts`.
        texts: Text messages since they were last taken away.
        problem: Error in the stream, with its remedy; nothing is cut after it.
    """

    def __init__(self, layout: Layout, frequency_hz: float) -> None:
        self._layout, self._frequency_hz = layout, frequency_hz
        self._rest = b""
        self._newest = float("nan")
        self.counts = Counts()
        self.texts: list[TextMessage] = []
        self.problem: tuple[str, str] | None = None

    @property
    def torn(self) -> int:
        """Bytes of a package that is not whole yet."""
        return len(self._rest)

    def feed(self, data: bytes, host_time: float) -> bytes:
        """The whole data packages that have come, one after the other.

        Args:
            data: Bytes of the socket.
            host_time: When, Unix time [s].
        """
        if self.problem is not None:
            return b""
        data = self._rest + data if self._rest else data
        runs, at = [], 0
        while len(data) - at >= SHORTEST and self.problem is None:
            if count := self._layout.whole_packages(data, at):
                end = at + count * self._layout.size
                runs.append(self._in_order(data[at:end]))
                at = end
                continue
            length = self._other(data, at, host_time)
            if not length:
                break
            at += length
        self._rest = data[at:]
        return runs[0] if len(runs) == 1 else b"".join(runs)

    def _other(self, data: bytes, at: int, host_time: float) -> int:
        """Length of a package that is not one of ours; 0 as long as it is not whole, or wrong."""
        size, kind = map(int, HEADER.unpack_from(data, at))
        if kind not in KINDS or size < SHORTEST:
            raw = data[at : at + 16].hex(" ")
            self.problem = (f"sends bytes that are no RTDE package: {raw}", NETWORK)
        elif kind == Kind.DATA:
            self._judge_data(data, at, size)
        elif len(data) - at >= size:
            if kind == Kind.TEXT:
                self.counts.texts += 1
                content = data[at + HEADER.size : at + size]
                self.texts.append(text_message(content, host_time))
            else:
                self.counts.others += 1
            return size
        return 0

    def _judge_data(self, data: bytes, at: int, size: int) -> None:
        """A data package that is not whole yet, or is none of this recipe."""
        expected = self._layout.size
        if size != expected:
            self.problem = (f"sent a data package of {size} bytes instead of {expected}", NETWORK)
        elif len(data) - at > HEADER.size and not self._layout.is_head(data, at):
            recipe = data[at + HEADER.size]
            self.problem = (f"sent a data package of recipe {recipe}, which is not ours", NETWORK)

    def _in_order(self, packages: bytes) -> bytes:
        """Count by the time stamps; packages from where the clock is wrong are cut off."""
        if len(packages) == self._layout.size:
            return self._next(packages)
        times = np.append(self._newest, self._layout.times(packages))
        # The step to the very first one is NaN: neither a gap nor a step back.
        steps = np.diff(times)
        wrong = (steps < 0) | ~np.isfinite(times[1:])
        if wrong.any():
            first = int(np.argmax(wrong))
            self.problem = _went_back(times[first], times[first + 1])
            steps, times = steps[:first], times[: first + 1]
        self._newest = float(times[-1])
        ticks = steps * self._frequency_hz
        gaps = ticks[ticks > LONG_STEP]
        self.counts.packages += len(steps)
        self.counts.duplicates += int((steps == 0).sum())
        self.counts.missing += int(np.rint(gaps).sum()) - len(gaps)
        return packages[: len(steps) * self._layout.size]

    def _next(self, package: bytes) -> bytes:
        """The same for one package, as it is at a robot's own pace: numpy costs five times more."""
        now = self._layout.time(package)
        step = now - self._newest
        if step < 0 or not math.isfinite(now):
            self.problem = _went_back(self._newest, now)
            return b""
        self._newest = now
        self.counts.packages += 1
        if step == 0:
            self.counts.duplicates += 1
        elif step * self._frequency_hz > LONG_STEP:
            self.counts.missing += round(step * self._frequency_hz) - 1
        return package


def _went_back(before: float, now: float) -> tuple[str, str]:
    if not math.isfinite(now):
        return f"says that its clock is at {now} s", NETWORK
    if before - now > BACK_IS_REBOOT_S:
        return (
            f"was restarted: its clock went back from {before:.3f} s to {now:.3f} s",
            "wait until the robot is up, see to it, connect again",
        )
    return f"sent states out of order: {now:.3f} s after {before:.3f} s", NETWORK


PROTOCOL = 2
CB3_HZ, E_SERIES_HZ = 125.0, 500.0

ROUNDS = 4
"""So often the outputs are asked for: a controller may refuse others the second time."""

_VERSION = struct.Struct(">IIII")
_FREQUENCY = struct.Struct(">d")

_REASONS = {
    "NOT_FOUND": "this software does not have it",
    "IN_USE": "another RTDE client or a fieldbus owns it",
}

_AWAY = "is the controller being restarted? too many RTDE clients? see its log and try again"
Version = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class Agreement:
    """The recipe and rate that a controller has agreed to.

    Attributes:
        version: Of its software: major, minor, bug-fix, build.
        frequency_hz: Packages per second asked for.
        layout: Of a data package.
        missing: Variables that are not sent → why not.
    """

    version: Version
    frequency_hz: float
    layout: Layout
    missing: Mapping[str, str]


class Conversation:
    """Questions and answers over one socket.

    Args:
        line: Connected.
        peer: The address, for messages.
        step_s: How long an answer may take [s].
        heard: Called with every text message.
    """

    def __init__(
        self,
        line: socket.socket,
        peer: str,
        step_s: float,
        heard: Callable[[TextMessage], object],
    ) -> None:
        self._line, self._peer, self._step_s, self._heard = line, peer, step_s, heard
        self._said: list[TextMessage] = []

    def agree(self, frequency_hz: float | None) -> Agreement:
        """Everything before the start.

        Args:
            frequency_hz: Packages per second; None for all that the controller makes.

        Raises:
            RobotConnectionError: No answer in time, no RTDE server, or one that refuses.
        """
        accepted = self._ask(Kind.VERSION, struct.pack(">H", PROTOCOL), "the protocol version")
        if accepted[:1] != b"\x01":
            raise self._problem(
                f"does not speak RTDE protocol {PROTOCOL}", "update the controller's software"
            )
        version = self._controller_version()
        fastest = CB3_HZ if version[0] <= 3 else E_SERIES_HZ
        rate = fastest if frequency_hz is None else frequency_hz
        if not 0 < rate <= fastest:
            raise self._problem(
                f"sends at most {fastest:g} packages per second, not {rate:g}",
                f"ask for a frequency up to {fastest:g} Hz, or for none",
            )
        wanted, missing = names_for(version[0])
        layout = self._outputs(wanted, rate, missing)
        return Agreement(version, rate, layout, missing)

    def start(self) -> None:
        """Let the controller send data packages.

        Raises:
            RobotConnectionError: The controller refuses, or does not answer.
        """
        if self._ask(Kind.START, b"", "the start")[:1] != b"\x01":
            raise self._problem(
                "refuses to send its state", "see the controller's log; restart it if need be"
            )

    def _controller_version(self) -> Version:
        content = self._ask(Kind.CONTROLLER, b"", "the controller's version")
        if len(content) != _VERSION.size:
            raise self._problem(
                f"tells its version in {len(content)} bytes instead of {_VERSION.size}",
                "is that a UR controller?",
            )
        major, minor, bugfix, build = _VERSION.unpack(content)
        return major, minor, bugfix, build

    def _outputs(self, wanted: list[str], rate: float, missing: dict[str, str]) -> Layout:
        """Ask until the controller has all remaining names; the others go to `missing`."""
        for _ in range(ROUNDS):
            question = _FREQUENCY.pack(rate) + ",".join(wanted).encode()
            answer = self._ask(Kind.OUTPUTS, question, "the list of outputs")
            types = answer[1:].decode("ascii", "replace").strip().rstrip(",").split(",")
            if len(types) != len(wanted):
                raise self._problem(
                    f"names {len(types)} types for {len(wanted)} outputs", "is that a UR robot?"
                )
            refused = {n: _reason(t) for n, t in zip(wanted, types, strict=True) if t not in TYPES}
            if not refused:
                if not answer[0]:
                    raise self._problem("refuses the list of outputs", "see the controller's log")
                return Layout(answer[0], wanted, types)
            self._require(refused)
            missing |= refused
            wanted = [name for name in wanted if name not in refused]
        raise self._problem(
            f"refuses other outputs every time: {', '.join(missing)}", "restart the controller"
        )

    def _require(self, refused: Mapping[str, str]) -> None:
        for name in REQUIRED:
            if name in refused:
                raise self._problem(
                    f"does not send {name}: {refused[name]}",
                    "end the other client, or update the controller's software",
                )

    def _ask(self, kind: Kind, content: bytes, what: str) -> bytes:
        """Send a question and wait for the answer of its kind."""
        deadline = time.monotonic() + self._step_s
        try:
            self._line.settimeout(self._step_s)
            self._line.sendall(package(kind, content))
            while True:
                size, came = HEADER.unpack(self._read(HEADER.size, deadline))
                if came not in KINDS or not SHORTEST <= size <= LONGEST:
                    raise self._problem(
                        f"answers {what} with something that is not RTDE",
                        f"is port {self._peer.rpartition(':')[2]} the RTDE port of a UR robot?",
                    )
                answer = self._read(size - HEADER.size, deadline)
                if came == kind and answer:
                    return answer
                if came != Kind.TEXT:
                    raise self._problem(
                        f"answers {what} by a package {chr(came)!r} of {len(answer)} bytes",
                        "is something between hil and the robot? connect directly",
                    )
                said = text_message(answer, time.time())
                self._said.append(said)
                self._heard(said)
        except TimeoutError as error:
            raise self._problem(
                f"has not answered {what} within {self._step_s:g} s",
                "it may be starting up, or have too many clients: try again, restart it if need be",
            ) from error
        except RobotConnectionError:
            raise
        except OSError as error:
            raise self._problem(f"broke off at {what}: {error}", _AWAY) from error

    def _read(self, count: int, deadline: float) -> bytes:
        got = bytearray()
        while len(got) < count:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._line.settimeout(left)
            more = self._line.recv(count - len(got))
            if not more:
                raise self._problem("hung up during the handshake", _AWAY)
            got += more
        return bytes(got)

    def _problem(self, what: str, hint: str) -> RobotConnectionError:
        said = "".join(f"; it says: {one}" for one in self._said[-3:])
        return RobotConnectionError(f"the controller at {self._peer} {what}{said}", hint=hint)


def _reason(token: str) -> str:
    return _REASONS.get(token, f"its type {token[:40]!r} is not known here")


HEADER = struct.Struct(">HB")

SHORTEST, LONGEST = HEADER.size, 65535
"""Of a package, with its header [bytes]."""

DATA_HEAD = struct.Struct(">HBB")
"""A data package begins with its header and the number of its recipe."""

_TIME = struct.Struct(">d")


class Kind(IntEnum):
    """The kind of a package."""

    VERSION = ord("V")
    CONTROLLER = ord("v")
    TEXT = ord("M")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


KINDS = frozenset(map(int, Kind))


def package(kind: Kind, content: bytes = b"") -> bytes:
    """A package, ready to be sent."""
    return HEADER.pack(HEADER.size + len(content), kind) + content


@dataclass(frozen=True, slots=True)
class TextMessage:
    """A text message of the controller.

    Attributes:
        text, source: As sent.
        level: 0 exception, 1 error, 2 warning, 3 information; −1 when it does not say.
        host_time: When it came, Unix time [s].
    """

    text: str
    source: str
    level: int
    host_time: float

    def __str__(self) -> str:
        return f"{self.source}: {self.text}" if self.source else self.text


def text_message(content: bytes, host_time: float) -> TextMessage:
    """A text message, as far as it is whole: words are for people, and no reason to end."""
    text, rest = _counted(content)
    source, rest = _counted(rest)
    return TextMessage(text, source, rest[0] if rest else -1, host_time)


def _counted(content: bytes) -> tuple[str, bytes]:
    end = 1 + (content[0] if content else 0)
    return content[1:end].decode("utf-8", "replace"), content[end:]


TYPES: Mapping[str, tuple[str, int]] = {
    "BOOL": ("|u1", 1),
    "UINT8": ("|u1", 1),
    "UINT32": ("<u4", 1),
    "UINT64": ("<u8", 1),
    "INT32": ("<i4", 1),
    "DOUBLE": ("<f8", 1),
    "VECTOR3D": ("<f8", 3),
    "VECTOR6D": ("<f8", 6),
    "VECTOR6INT32": ("<i4", 6),
    "VECTOR6UINT32": ("<u4", 6),
}
"""Type as RTDE names it → numpy type of one value in a row, and how many of them."""

_SWAPPED = {8: (">u8", "<u8"), 4: (">u4", "<u4"), 1: ("|u1", "|u1")}


class Layout:
    """Where the variables of an output recipe lie, in a package and in a row.

    Neighbours of one width are swapped to this machine's byte order in one go, so a recipe that
    is sorted by width costs a few copies, however many variables it has.

    Args:
        recipe: Number of the recipe, as the controller gave it.
        names: Variables in order; the first one is `timestamp`.
        types: Their types as RTDE names them, all of them in `TYPES`.

    Attributes:
        dtype: Of a row: `host_time` (float64, Unix time [s]) and the variables by name.
        size: Of a data package [bytes].
        head: The first four bytes of every data package, as one number.
    """

    def __init__(self, recipe: int, names: Sequence[str], types: Sequence[str]) -> None:
        kinds = [TYPES[one] for one in types]
        fields = [
            (name, code) if count == 1 else (name, code, (count,))
            for name, (code, count) in zip(names, kinds, strict=True)
        ]
        self.names, self.types = tuple(names), tuple(types)
        self.dtype: np.dtype[Any] = np.dtype([("host_time", "<f8"), *fields])
        blocks = _blocks(kinds)
        self._blocks = [f"block{i}" for i in range(len(blocks))]
        self._wire = np.dtype(
            [("head", ">u4")]
            + [(b, _SWAPPED[w][0], (n,)) for b, (w, n) in zip(self._blocks, blocks, strict=True)]
        )
        self._native = np.dtype(
            [("host_time", "<f8")]
            + [(b, _SWAPPED[w][1], (n,)) for b, (w, n) in zip(self._blocks, blocks, strict=True)]
        )
        self.size = self._wire.itemsize
        self.head = int.from_bytes(DATA_HEAD.pack(self.size, Kind.DATA, recipe), "big")
        self._times = np.dtype(
            {"names": ["t"], "formats": [">f8"], "offsets": [4], "itemsize": self.size}
        )

    def whole_packages(self, data: bytes, begin: int) -> int:
        """How many data packages of this recipe follow each other in `data` from `begin`."""
        count = (len(data) - begin) // self.size
        if count < 2:  # the usual case at a robot's own pace, without numpy's overhead
            return int(count == 1 and self.is_head(data, begin))
        good = np.frombuffer(data, self._wire, count, begin)["head"] == self.head
        return count if good.all() else int(np.argmin(good))

    def is_head(self, data: bytes, begin: int) -> bool:
        """Return whether a data package of this recipe begins here."""
        return int.from_bytes(data[begin : begin + 4], "big") == self.head

    def time(self, package: bytes) -> float:
        """Timestamp of one whole data package [s]."""
        return float(_TIME.unpack_from(package, DATA_HEAD.size)[0])

    def times(self, packages: bytes) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(N,) timestamps of whole data packages [s]."""
        return np.frombuffer(packages, self._times)["t"].astype(np.float64)

    def rows(self, packages: bytes, host_time: Any) -> StructArray:
        """Whole data packages as rows.

        Args:
            packages: One after the other.
            host_time: When they came, a number or (N,).
        """
        seen = np.frombuffer(packages, self._wire)
        out = np.empty(len(seen), self._native)
        out["host_time"] = host_time
        for block in self._blocks:
            out[block] = seen[block]
        return out.view(self.dtype)


def _blocks(kinds: Sequence[tuple[str, int]]) -> list[tuple[int, int]]:
    """(width, count) of the runs of values of one width."""
    widths = [(np.dtype(code).itemsize, count) for code, count in kinds]
    return [
        (width, sum(count for _, count in group))
        for width, group in groupby(widths, key=lambda one: one[0])
    ]


@dataclass(frozen=True, slots=True)
class Field:
    """One RTDE output.

    Attributes:
        name, type: As RTDE has them.
        unit: For the recording; empty for bits, modes and ratios.
        since: `e` for what no CB3 controller has. Other differences come out when asking.
    """

    name: str
    type: str
    unit: str = ""
    since: Literal["always", "e"] = "always"


REQUIRED = ("timestamp", "actual_q", "actual_qd")
"""Without these there is nothing to record."""

FIELDS = (
    Field("timestamp", "DOUBLE", "s"),
    Field("target_q", "VECTOR6D", "rad"),
    Field("target_qd", "VECTOR6D", "rad/s"),
    Field("target_qdd", "VECTOR6D", "rad/s^2"),
    Field("target_current", "VECTOR6D", "A"),
    Field("target_moment", "VECTOR6D", "N·m"),
    Field("actual_q", "VECTOR6D", "rad"),
    Field("actual_qd", "VECTOR6D", "rad/s"),
    Field("actual_current", "VECTOR6D", "A"),
    Field("joint_temperatures", "VECTOR6D", "°C"),
    Field("actual_current_as_torque", "VECTOR6D", "N·m", "e"),
    Field("actual_current_window", "VECTOR6D", "A", "e"),
    Field("joint_control_output", "VECTOR6D", "A"),
    Field("actual_joint_voltage", "VECTOR6D", "V"),
    Field("actual_TCP_pose", "VECTOR6D", "m, rad (rotation vector)"),
    Field("actual_TCP_speed", "VECTOR6D", "m/s, rad/s"),
    Field("actual_TCP_force", "VECTOR6D", "N, N·m"),
    Field("target_TCP_pose", "VECTOR6D", "m, rad (rotation vector)"),
    Field("target_TCP_speed", "VECTOR6D", "m/s, rad/s"),
    Field("tcp_offset", "VECTOR6D", "m, rad (rotation vector)", "e"),
    Field("ft_raw_wrench", "VECTOR6D", "N, N·m", "e"),
    Field("payload_inertia", "VECTOR6D", "kg·m^2 (xx yy zz xy xz yz)"),
    Field("payload_cog", "VECTOR3D", "m"),
    Field("payload", "DOUBLE", "kg"),
    Field("actual_tool_accelerometer", "VECTOR3D", "m/s^2"),
    Field("elbow_position", "VECTOR3D", "m"),
    Field("elbow_velocity", "VECTOR3D", "m/s"),
    Field("actual_execution_time", "DOUBLE", "ms"),
    Field("speed_scaling", "DOUBLE"),
    Field("target_speed_fraction", "DOUBLE"),
    Field("actual_momentum", "DOUBLE", "kg·m/s"),
    Field("tcp_force_scalar", "DOUBLE", "N"),
    Field("joint_position_deviation_ratio", "DOUBLE", "", "e"),
    Field("collision_detection_ratio", "DOUBLE", "", "e"),
    Field("actual_main_voltage", "DOUBLE", "V"),
    Field("actual_robot_voltage", "DOUBLE", "V"),
    Field("actual_robot_current", "DOUBLE", "A"),
    Field("io_current", "DOUBLE", "mA"),
    Field("tool_output_current", "DOUBLE", "mA"),
    Field("tool_temperature", "DOUBLE", "°C"),
    Field("standard_analog_input0", "DOUBLE", "A or V"),
    Field("standard_analog_input1", "DOUBLE", "A or V"),
    Field("standard_analog_output0", "DOUBLE", "A or V"),
    Field("standard_analog_output1", "DOUBLE", "A or V"),
    Field("actual_digital_input_bits", "UINT64"),
    Field("actual_digital_output_bits", "UINT64"),
    Field("robot_mode", "INT32"),
    Field("joint_mode", "VECTOR6INT32"),
    Field("safety_mode", "INT32"),
    Field("safety_status", "INT32"),
    Field("time_scale_source", "INT32", "", "e"),
    Field("runtime_state", "UINT32"),
    Field("robot_status_bits", "UINT32"),
    Field("safety_status_bits", "UINT32"),
    Field("script_control_line", "UINT32", "", "e"),
)


def names_for(major: int) -> tuple[list[str], dict[str, str]]:
    """Return the outputs to ask a controller for, and those missing anyway with the reason.

    Args:
        major: Of the controller's software: 3 for CB3, 5 for e-Series, 10 for PolyScope X.
    """
    wanted = [field.name for field in FIELDS if major > 3 or field.since == "always"]
    why = "no CB3 controller has it"
    return wanted, {field.name: why for field in FIELDS if field.name not in wanted}
