"""The thread that takes every data package a controller sends, as soon as it comes."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections import deque

import numpy as np

from hil.core import RobotConnectionError, RobotTimeout, StructArray
from hil_drivers.ur.cutting import Counts, Cutter
from hil_drivers.ur.handshake import Agreement
from hil_drivers.ur.rtde_wire import TextMessage

READ_BYTES = 1 << 18
KEPT_TEXTS = 200
PATIENCE_S = 2.0
"""How long a full queue is waited for; what comes meanwhile stays with the kernel [s]."""

HURRY_S = 1e-3
"""What follows sooner is read together: no robot is so fast, but simulated ones are, and waking up
for each state would cost them more than making it [s]."""

_CLOSED = ("is not listened to any more: its connection was closed", "connect again")


class Stream:
    """Rows of a started controller, in a bounded queue; lossless, or an error that says so.

    Args:
        line: Connected and started; this object closes it.
        peer: The address, for messages.
        agreement: What it sends.
        silence_s: Without a data package for so long, the connection counts as lost [s].
        capacity_s: How much waits to be taken at most, by the robot's clock [s].
        texts: Where text messages go; the oldest are forgotten.

    Attributes:
        keep: Rows that wait to be taken at most, older ones being let go; None for all of them.
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
        """What has come so far."""
        return self._cutter.counts

    @property
    def alive(self) -> bool:
        """Whether data packages may still come."""
        return self._problem is None

    @property
    def age_s(self) -> float:
        """Since the controller's clock was last heard to go on, or since the start [s].

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
        except Exception as error:  # nobody would ever hear of it in this thread
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
            self._forget()
            self.counts.deepest = max(self.counts.deepest, self._waiting)
            self._changed.notify_all()
            if not self._changed.wait_for(self._has_room, PATIENCE_S):
                self._nobody_takes()
        self._heard = time.monotonic() if goes_on else self._heard

    def _nobody_takes(self) -> None:
        """The queue is full, and stays so."""
        if self.forgiving:
            self._let_go_beyond(self._capacity // 2)
            return
        self._problem = (
            f"was not listened to: {self._waiting} states wait to be taken",
            "hil is held up: look for a busy machine or a slow disk",
        )
        self._changed.notify_all()

    def _forget(self) -> None:
        """Let go of the oldest as far as the rest is as much as is to be kept."""
        if self.keep is not None:
            self._let_go_beyond(self.keep)

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


_LOST = "see to the robot: is it on, is the cable in, was it restarted? then connect again"
