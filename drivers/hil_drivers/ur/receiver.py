"""What a UR controller tells, lossless: our own RTDE client, which takes every package.

`ur-rtde` keeps the latest state only and drops what came before it; a recording needs them all.
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np

from hil.core import RobotConnectionError, StructArray
from hil_drivers.ur.cutting import Counts
from hil_drivers.ur.handshake import Agreement, Conversation, Version
from hil_drivers.ur.rtde_wire import TextMessage
from hil_drivers.ur.stream import KEPT_TEXTS, Stream

RTDE_PORT = 30004
STEP_S = 2.0
SILENCE_S = 2.0
CAPACITY_S = 60.0


class Receiver:
    """Listens to one controller and commands nothing; any number of clients may.

    Args:
        host: Address of the controller.
        frequency_hz: States per second; None for all there are (125 on CB3, 500 on e-Series).
        port: Of the RTDE server.
        also: RTDE outputs beyond the recorded ones (`hil_drivers.ur.fields`), such as registers.
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
        also: Sequence[str] = (),
        step_s: float = STEP_S,
        silence_s: float = SILENCE_S,
        capacity_s: float = CAPACITY_S,
    ) -> None:
        self._address, self._peer = (host, port), f"{host}:{port}"
        self._asked_hz, self._also, self._step_s = frequency_hz, tuple(also), step_s
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
        """What has come since `open`."""
        return self._stream.counts if self._stream else Counts()

    @property
    def alive(self) -> bool:
        """Whether states may still come."""
        return self._stream is not None and self._stream.alive

    @property
    def age_s(self) -> float:
        """How long ago the controller's clock was last heard to go on [s].

        A state that is repeated is no news; infinite when not connected.
        """
        return self._stream.age_s if self._stream and self._stream.alive else math.inf

    @property
    def newest(self) -> StructArray | None:
        """The newest row, shape (1,), whether it was taken or not; None before the first."""
        return self._stream.newest if self._stream else None

    def open(self) -> None:
        """Connect, agree on what is sent, and start; does nothing while connected.

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
                self._agreement = talk.agree(self._asked_hz, self._also)
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
        """From now on let go of rows that wait for longer than that, by the robot's clock.

        Args:
            seconds: None to lose nothing, as after `open`.
            forgiving: When `capacity_s` wait nevertheless, let go of the oldest instead of ending.
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
        """End the connection. Idempotent, from any thread; whoever waits in `take` hears of it."""
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
                hint="is the robot on, the cable in, the address right, RTDE not disabled in the "
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
