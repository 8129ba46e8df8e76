"""Lossless Real-Time Data Exchange (RTDE) client for the state of a UR controller.

The library `ur-rtde`, which moves the arm, retains only the latest state of the controller. A
recording needs every state, so this module contains a separate client.

`Receiver` is the class that the driver uses: `Receiver` connects, returns rows and closes the
connection.

`Stream` is the receiving thread. The thread reads the socket as soon as data arrives and stores the
packages in a bounded queue. If the queue is full, the thread stops reading: data then waits in the
kernel and in the controller, and after `PATIENCE_S` the stream fails with an error. No package is
dropped silently.

`Cutter` splits the byte stream into packages and checks their time stamps for gaps.

`Conversation` negotiates the outputs with the controller; the result of the negotiation is an
`Agreement`. Outputs that the series or software of the controller lacks are left out of the
recording. Text messages of the controller are accepted between a request and its answer.

`Layout` converts many packages at a time into rows. The byte order of all neighbouring values of
equal width is swapped in one operation.

`FIELDS` lists the recorded outputs.

Every RTDE package consists of `size` (u16, number of bytes of the whole package), `kind` (u8) and
content, in network byte order.

The source is Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
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
    """Receiver of the states of one controller, without any commands to the controller.

    Several receivers can be connected to the same controller.

    Args:
        host: Address of the controller.
        frequency_hz: Requested states per second; None for the maximum rate (125 Hz on CB3, 500 Hz
            on e-Series).
        port: TCP port of the RTDE server.
        step_s: Timeout for the connection and for each step of the handshake [s].
        silence_s: Duration without a new state after which the connection counts as lost [s].
        capacity_s: Maximum duration of queued rows by the controller's clock [s]. If the queue is
            full, the kernel and then the controller buffer the data; after two more seconds the
            stream fails.

    Attributes:
        messages: Latest text messages of the controller, at most `KEPT_TEXTS`.
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
        """Software version of the controller: major, minor, bug-fix, build."""
        return self._agreed.version

    @property
    def frequency_hz(self) -> float:
        """Agreed number of states per second."""
        return self._agreed.frequency_hz

    @property
    def missing(self) -> Mapping[str, str]:
        """Outputs that this controller does not send, each with the reason."""
        return self._agreed.missing

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the rows: `host_time` and the RTDE outputs by their names."""
        return self._agreed.layout.dtype

    @property
    def counts(self) -> Counts:
        """Counts of packages and rows since `open`."""
        return self._stream.counts if self._stream else Counts()

    @property
    def alive(self) -> bool:
        """Whether the stream is open, so that more states can arrive."""
        return self._stream is not None and self._stream.alive

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced [s].

        A repeated state does not reset this time. The time is infinite if the receiver is not
        connected.
        """
        return self._stream.age_s if self._stream and self._stream.alive else math.inf

    @property
    def newest(self) -> StructArray | None:
        """Newest row with shape (1,), even if `take` has already returned this row.

        The value is None before the first row arrives.
        """
        return self._stream.newest if self._stream else None

    def open(self) -> None:
        """Connect, negotiate the outputs and start the stream; do nothing if already connected.

        Raises:
            RobotConnectionError: No RTDE server answers, the server refuses, or another thread
                called `close` in the meantime.
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
        """Set the maximum age of queued rows by the controller's clock; drop older rows.

        Args:
            seconds: Maximum age of queued rows [s]; None to drop no row, which is the setting after
                `open`.
            forgiving: Whether the oldest rows are dropped, instead of ending the stream, if the
                queue reaches `capacity_s`.
        """
        if self._stream is not None:
            rate = self.frequency_hz
            self._stream.forgiving = forgiving
            self._stream.keep = None if seconds is None else max(1, int(seconds * rate))

    def take(self, timeout_s: float = 1.0) -> StructArray:
        """Return all rows since the last call, at least one row, in order; their type is `dtype`.

        Raises:
            RobotTimeout: No row arrived within `timeout_s`.
            RobotConnectionError: The receiver was never opened, or the connection is lost and
                earlier calls returned all rows received before.
        """
        if self._stream is None:
            raise self._not_open()
        return self._stream.take(timeout_s)

    def close(self) -> None:
        """Close the connection; any thread can call this method, and repeated calls have no effect.

        A call of `take` that waits in another thread raises an error.
        """
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
                + "check that the robot is on, the cable plugged in, the address right and RTDE "
                "enabled in the controller's security settings",
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
"""Maximum wait for space in a full queue [s]; meanwhile the kernel buffers the incoming data."""

HURRY_S = 1e-3
"""Minimum interval between two reads of the socket [s].

Data that arrive within this interval are read together. A real robot never sends two packages
within the interval. Simulated robots do, and waking up for each state would take longer than
generating the state.
"""

_CLOSED = ("is no longer read: the connection was closed", "connect again")
_LOST = "check that the robot is on, the cable plugged in and no restart in progress; connect again"


class Stream:
    """Receiving thread with a bounded queue of rows; no loss without an error.

    Args:
        line: Connected socket on which data packages have been started; the stream closes the
            socket.
        peer: Address of the controller, for error messages.
        agreement: Agreement with the controller about its outputs.
        silence_s: Duration without a new state after which the connection counts as lost [s].
        capacity_s: Maximum duration of queued rows by the controller's clock [s].
        texts: Queue that receives the text messages of the controller; the oldest are dropped.

    Attributes:
        keep: Maximum number of queued rows, beyond which the oldest rows are dropped; None to keep
            all rows.
        forgiving: Whether the oldest rows are dropped if the queue stays full. If `forgiving` is
            false, a queue that stays full ends the stream.
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
        """Counts of packages and rows so far."""
        return self._cutter.counts

    @property
    def alive(self) -> bool:
        """Whether the stream has no error yet, so that more data packages can arrive."""
        return self._problem is None

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced, or since the start of the stream [s].

        A package that repeats the previous state does not reset this time.
        """
        return time.monotonic() - self._heard

    @property
    def newest(self) -> StructArray | None:
        """Newest row with shape (1,), even if `take` has already returned this row.

        The value is None before the first row arrives.
        """
        newest = self._newest
        return None if newest is None else self._layout.rows(*newest)

    def take(self, timeout_s: float) -> StructArray:
        """Return all rows since the last call, at least one row, in order.

        Raises:
            RobotTimeout: No row arrived within `timeout_s`.
            RobotConnectionError: The stream has ended and no row is left in the queue.
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
        """Close the connection.

        Any thread can call this method, and repeated calls have no effect.
        """
        self._fail(_CLOSED)
        with contextlib.suppress(OSError):  # the connection was already closed
            self._line.shutdown(socket.SHUT_RDWR)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _why_nothing(self, timeout_s: float) -> Exception:
        if self._problem is None:
            return RobotTimeout(
                f"the controller at {self._peer} has sent no state for {timeout_s:g} s",
                hint="check cable, switch and controller",
            )
        what, hint = self._problem
        said = "".join(f"; its message: {text}" for text in list(self._texts)[-2:])
        return RobotConnectionError(f"the controller at {self._peer} {what}{said}", hint=hint)

    def _run(self) -> None:
        try:
            while self._problem is None:
                self._read()
        except OSError as error:
            self._fail((f"broke the connection: {error.strerror or error}", _LOST))
        except Exception as error:  # an unhandled error in this thread would go unnoticed
            self._fail((f"could not be read: {error!r}", "report this as a bug of hil"))
        finally:
            self._line.close()

    def _read(self) -> None:
        if time.monotonic() - self._read_at < HURRY_S:
            time.sleep(HURRY_S)
        try:
            data = self._line.recv(READ_BYTES)
        except TimeoutError:
            if self.age_s > self._silence_s:
                self._fail((f"has been silent for {self.age_s:.1f} s", _LOST))
            return
        host_time, self._read_at = time.time(), time.monotonic()
        if not data:
            half = f" in the middle of a package ({self._cutter.torn} bytes of it)"
            torn = half if self._cutter.torn else ""
            self._fail((f"closed the connection{torn} after {self.counts.packages} states", _LOST))
            return
        packages = self._cutter.feed(data, host_time)
        self._texts.extend(self._cutter.texts)
        self._cutter.texts.clear()
        if packages:
            self._put(packages, host_time)
        if self.age_s > self._silence_s:
            what = "repeated one state with a stopped clock" if packages else "sent no state"
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
            # Received rows are always stored: the queue can exceed its capacity by one read.
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
        """Handle a queue that has stayed full: drop the oldest rows or end the stream."""
        if self.forgiving:
            self._let_go_beyond(self._capacity // 2)
            return
        self._problem = (
            f"was not read in time: {self._waiting} states are waiting",
            "hil is delayed: look for a busy computer or a slow disk",
        )
        self._changed.notify_all()

    def _let_go_beyond(self, rows: int) -> None:
        while self._queue and self._waiting - self._queue[0][2] >= rows:
            self._waiting -= self._queue.popleft()[2]

    def _has_room(self) -> bool:
        return self._waiting < self._capacity or self._problem is not None

    def _fail(self, problem: tuple[str, str]) -> None:
        """Record the problem that ends the stream; only the first problem is retained."""
        with self._changed:
            self._problem = self._problem or problem
            self._changed.notify_all()


BACK_IS_REBOOT_S = 1.0
"""Backward step of the controller's clock above which the controller counts as restarted [s]."""

LONG_STEP = 1.5
"""Number of ticks between two consecutive states above which the states between them count as
missing."""

NETWORK = "check cable and switch; connect the robot directly"


@dataclass(slots=True)
class Counts:
    """Counts of rows and packages since the connection was opened.

    Attributes:
        packages: Number of data packages.
        missing: Number of missing data packages, inferred from the time stamps of their neighbours.
        duplicates: Number of data packages with the time stamp of the previous package.
        texts: Number of text messages.
        others: Number of packages of other kinds, which are not expected after the start.
        deepest: Maximum number of rows that have waited in the queue.
    """

    packages: int = 0
    missing: int = 0
    duplicates: int = 0
    texts: int = 0
    others: int = 0
    deepest: int = 0


class Cutter:
    """Splitter of the bytes of a socket into whole packages.

    Args:
        layout: Layout of the data packages.
        frequency_hz: Expected number of data packages per second.

    Attributes:
        counts: Counts of packages; see `Counts`.
        texts: Text messages that the stream has not yet collected.
        problem: Message and remedy of an error in the byte stream; no package is returned after an
            error.
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
        """Number of received bytes of the last package, which is still incomplete."""
        return len(self._rest)

    def feed(self, data: bytes, host_time: float) -> bytes:
        """Process received bytes; return the data packages that are now complete, concatenated.

        Args:
            data: Bytes read from the socket.
            host_time: Unix time at which the bytes were read [s].
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
        """Process a package that is not a data package of the agreed recipe; return its length.

        The returned length is 0 if the package is incomplete or invalid.
        """
        size, kind = map(int, HEADER.unpack_from(data, at))
        if kind not in KINDS or size < SHORTEST:
            raw = data[at : at + 16].hex(" ")
            self.problem = (f"sent bytes that are not an RTDE package: {raw}", NETWORK)
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
        """Check the head of a data package that is incomplete or has the wrong size or recipe."""
        expected = self._layout.size
        if size != expected:
            self.problem = (f"sent a data package of {size} bytes instead of {expected}", NETWORK)
        elif len(data) - at > HEADER.size and not self._layout.is_head(data, at):
            recipe = data[at + HEADER.size]
            self.problem = (f"sent a data package of the unknown recipe {recipe}", NETWORK)

    def _in_order(self, packages: bytes) -> bytes:
        """Update the counts from the time stamps and return the packages in order.

        Packages after an invalid time stamp are cut off.
        """
        if len(packages) == self._layout.size:
            return self._next(packages)
        times = np.append(self._newest, self._layout.times(packages))
        # The step to the very first time stamp is NaN, which counts neither as a gap nor as
        # backward.
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
        """Check and count a single package, as `_in_order` does for several packages.

        At the rate of a real robot, packages usually arrive one by one, and numpy would take five
        times longer for a single package.
        """
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
        return f"sent the invalid time stamp {now} s", NETWORK
    if before - now > BACK_IS_REBOOT_S:
        return (
            f"was restarted: its clock went back from {before:.3f} s to {now:.3f} s",
            "wait until the controller has started, check the robot, connect again",
        )
    return f"sent states out of order: {now:.3f} s after {before:.3f} s", NETWORK


PROTOCOL = 2
CB3_HZ, E_SERIES_HZ = 125.0, 500.0

ROUNDS = 4
"""Maximum number of requests for the outputs, because a controller can refuse further outputs in
each answer."""

_VERSION = struct.Struct(">IIII")
_FREQUENCY = struct.Struct(">d")

_REASONS = {
    "NOT_FOUND": "not available in this software",
    "IN_USE": "another RTDE client or a fieldbus owns it",
}

_AWAY = "check for a restart or too many RTDE clients in the controller's log, then try again"
Version = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class Agreement:
    """Output recipe and rate that a controller has accepted.

    Attributes:
        version: Software version of the controller: major, minor, bug-fix, build.
        frequency_hz: Requested number of packages per second.
        layout: Layout of a data package.
        missing: Outputs that the controller does not send, each with the reason.
    """

    version: Version
    frequency_hz: float
    layout: Layout
    missing: Mapping[str, str]


class Conversation:
    """Handshake with the RTDE server over one socket: requests and answers.

    Args:
        line: Connected socket.
        peer: Address of the controller, for error messages.
        step_s: Timeout for each answer [s].
        heard: Function called with every text message.
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
        """Negotiate protocol version, rate and outputs with the controller before the start.

        Args:
            frequency_hz: Packages per second; None for the maximum rate of the controller.

        Raises:
            RobotConnectionError: No answer arrives in time, the peer is not an RTDE server, or the
                server refuses.
        """
        accepted = self._ask(Kind.VERSION, struct.pack(">H", PROTOCOL), "the protocol version")
        if accepted[:1] != b"\x01":
            raise self._problem(
                f"does not support RTDE protocol {PROTOCOL}", "update the controller's software"
            )
        version = self._controller_version()
        fastest = CB3_HZ if version[0] <= 3 else E_SERIES_HZ
        rate = fastest if frequency_hz is None else frequency_hz
        if not 0 < rate <= fastest:
            raise self._problem(
                f"sends at most {fastest:g} packages per second, not {rate:g}",
                f"request at most {fastest:g} Hz, or omit the frequency",
            )
        wanted, missing = names_for(version[0])
        layout = self._outputs(wanted, rate, missing)
        return Agreement(version, rate, layout, missing)

    def start(self) -> None:
        """Request the start of data packages.

        Raises:
            RobotConnectionError: The controller refuses the request, or does not answer.
        """
        if self._ask(Kind.START, b"", "the start")[:1] != b"\x01":
            raise self._problem(
                "refuses to send its state", "see the controller's log; restart it if necessary"
            )

    def _controller_version(self) -> Version:
        content = self._ask(Kind.CONTROLLER, b"", "the controller's version")
        if len(content) != _VERSION.size:
            raise self._problem(
                f"sent its version in {len(content)} bytes instead of {_VERSION.size}",
                "check that the address is that of a UR controller",
            )
        major, minor, bugfix, build = _VERSION.unpack(content)
        return major, minor, bugfix, build

    def _outputs(self, wanted: list[str], rate: float, missing: dict[str, str]) -> Layout:
        """Request the outputs until the controller accepts all remaining names.

        Refused names are added to `missing` with the reason.
        """
        for _ in range(ROUNDS):
            question = _FREQUENCY.pack(rate) + ",".join(wanted).encode()
            answer = self._ask(Kind.OUTPUTS, question, "the list of outputs")
            types = answer[1:].decode("ascii", "replace").strip().rstrip(",").split(",")
            if len(types) != len(wanted):
                raise self._problem(
                    f"returned {len(types)} types for {len(wanted)} outputs",
                    "check that the address is that of a UR controller",
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
            f"refused further outputs at each request: {', '.join(missing)}",
            "restart the controller",
        )

    def _require(self, refused: Mapping[str, str]) -> None:
        for name in REQUIRED:
            if name in refused:
                raise self._problem(
                    f"does not send {name}: {refused[name]}",
                    "end the other client, or update the controller's software",
                )

    def _ask(self, kind: Kind, content: bytes, what: str) -> bytes:
        """Send a request and return the content of the answer of the same kind."""
        deadline = time.monotonic() + self._step_s
        try:
            self._line.settimeout(self._step_s)
            self._line.sendall(package(kind, content))
            while True:
                size, came = HEADER.unpack(self._read(HEADER.size, deadline))
                if came not in KINDS or not SHORTEST <= size <= LONGEST:
                    raise self._problem(
                        f"answered {what} with data that is not RTDE",
                        f"check that {self._peer.rpartition(':')[2]} is the RTDE port of a UR",
                    )
                answer = self._read(size - HEADER.size, deadline)
                if came == kind and answer:
                    return answer
                if came != Kind.TEXT:
                    raise self._problem(
                        f"answered {what} by a package {chr(came)!r} of {len(answer)} bytes",
                        "connect directly to the robot, without a device in between",
                    )
                said = text_message(answer, time.time())
                self._said.append(said)
                self._heard(said)
        except TimeoutError as error:
            raise self._problem(
                f"has not answered {what} within {self._step_s:g} s",
                "check for a restart or too many RTDE clients; try again, then restart it",
            ) from error
        except RobotConnectionError:
            raise
        except OSError as error:
            raise self._problem(f"broke the connection at {what}: {error}", _AWAY) from error

    def _read(self, count: int, deadline: float) -> bytes:
        got = bytearray()
        while len(got) < count:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._line.settimeout(left)
            more = self._line.recv(count - len(got))
            if not more:
                raise self._problem("closed the connection during the handshake", _AWAY)
            got += more
        return bytes(got)

    def _problem(self, what: str, hint: str) -> RobotConnectionError:
        said = "".join(f"; its message: {one}" for one in self._said[-3:])
        return RobotConnectionError(f"the controller at {self._peer} {what}{said}", hint=hint)


def _reason(token: str) -> str:
    return _REASONS.get(token, f"its type {token[:40]!r} is unknown")


HEADER = struct.Struct(">HB")

SHORTEST, LONGEST = HEADER.size, 65535
"""Minimum and maximum size of a package, including its header [bytes]."""

DATA_HEAD = struct.Struct(">HBB")
"""First bytes of a data package: header and number of the output recipe."""

_TIME = struct.Struct(">d")


class Kind(IntEnum):
    """Kind of an RTDE package."""

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
    """Return the bytes of a package with its header."""
    return HEADER.pack(HEADER.size + len(content), kind) + content


@dataclass(frozen=True, slots=True)
class TextMessage:
    """Text message of the controller.

    Attributes:
        text, source: Text and source of the message, as sent by the controller.
        level: Severity: 0 exception, 1 error, 2 warning, 3 information; −1 if not sent.
        host_time: Unix time of arrival [s].
    """

    text: str
    source: str
    level: int
    host_time: float

    def __str__(self) -> str:
        return f"{self.source}: {self.text}" if self.source else self.text


def text_message(content: bytes, host_time: float) -> TextMessage:
    """Return the text message in the content of a package; an incomplete message is no error.

    Text messages are only displayed, so a truncated message does not end the connection.
    """
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
"""Map from RTDE type name to the numpy type of one value in a row, and the number of values."""

_SWAPPED = {8: (">u8", "<u8"), 4: (">u4", "<u4"), 1: ("|u1", "|u1")}


class Layout:
    """Positions of the variables of an output recipe, in a package and in a row.

    When packages are converted, the byte order of neighbouring values of equal width is swapped in
    one operation. A recipe whose variables are sorted by width therefore needs only a few copy
    operations, whatever the number of variables.

    Args:
        recipe: Number of the recipe, assigned by the controller.
        names: Names of the variables in order; the first name is `timestamp`.
        types: RTDE types of the variables; all must be keys of `TYPES`.

    Attributes:
        dtype: Data type of a row: `host_time` (float64, Unix time [s]) and the variables by name.
        size: Size of a data package [bytes].
        head: First four bytes of every data package, as one integer.
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
        """Return the number of consecutive data packages of this recipe in `data` from `begin`."""
        count = (len(data) - begin) // self.size
        if count < 2:  # usual at a real robot's rate: avoid the overhead of numpy
            return int(count == 1 and self.is_head(data, begin))
        good = np.frombuffer(data, self._wire, count, begin)["head"] == self.head
        return count if good.all() else int(np.argmin(good))

    def is_head(self, data: bytes, begin: int) -> bool:
        """Return whether a data package of this recipe begins at index `begin` of `data`."""
        return int.from_bytes(data[begin : begin + 4], "big") == self.head

    def time(self, package: bytes) -> float:
        """Return the time stamp of one whole data package [s]."""
        return float(_TIME.unpack_from(package, DATA_HEAD.size)[0])

    def times(self, packages: bytes) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return the time stamps of whole data packages, (N,) [s]."""
        return np.frombuffer(packages, self._times)["t"].astype(np.float64)

    def rows(self, packages: bytes, host_time: Any) -> StructArray:
        """Convert whole data packages into rows.

        Args:
            packages: Concatenated data packages.
            host_time: Unix time of arrival, a number or (N,) [s].
        """
        seen = np.frombuffer(packages, self._wire)
        out = np.empty(len(seen), self._native)
        out["host_time"] = host_time
        for block in self._blocks:
            out[block] = seen[block]
        return out.view(self.dtype)


def _blocks(kinds: Sequence[tuple[str, int]]) -> list[tuple[int, int]]:
    """Return (width, count) of each run of neighbouring values of equal width in bytes."""
    widths = [(np.dtype(code).itemsize, count) for code, count in kinds]
    return [
        (width, sum(count for _, count in group))
        for width, group in groupby(widths, key=lambda one: one[0])
    ]


@dataclass(frozen=True, slots=True)
class Field:
    """RTDE output that is recorded.

    Attributes:
        name, type: Name and type of the output in the RTDE guide.
        unit: Unit in the recording; empty for bits, modes and ratios.
        since: `e` for outputs that no CB3 controller has, `always` for all other outputs. Other
            differences between controllers are detected in the handshake.
    """

    name: str
    type: str
    unit: str = ""
    since: Literal["always", "e"] = "always"


REQUIRED = ("timestamp", "actual_q", "actual_qd")
"""Outputs without which a recording is impossible."""

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
    """Return the outputs to request from a controller, and the unavailable outputs with the reason.

    Args:
        major: Major software version of the controller: 3 for CB3, 5 for e-Series, 10 for PolyScope
            X.
    """
    wanted = [field.name for field in FIELDS if major > 3 or field.since == "always"]
    why = "not available on a CB3 controller"
    return wanted, {field.name: why for field in FIELDS if field.name not in wanted}
