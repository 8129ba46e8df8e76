"""A robot without physics: goes exactly where it is told, on a virtual clock. For engine tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, RobotConnectionError
from hil.core.typing import FloatArray, StructArray
from hil.robot import Capabilities, Identity, Limits, Segment, Status, state_dtype

N = 6
BLOCK = 8


def require_within(segment: Segment, limits: Limits) -> None:
    """Refuse what leaves the limits."""
    beyond = (segment.q > limits.q_max) | (segment.q < limits.q_min)
    beyond |= (np.abs(segment.qd) > limits.qd_max) | (np.abs(segment.qdd) > limits.qdd_max)
    if beyond.any():
        raise CommandRefused(f"segment {segment.index} leaves the limits")


class KinematicRobot:
    """Set-points become measurements; `disturb` may change a block before it is handed out."""

    def __init__(self, disturb: Callable[[StructArray], None] = lambda block: None) -> None:
        self.disturb = disturb
        self.calls: list[str] = []
        self.connected = False
        self.q: FloatArray = np.zeros(N)
        self.ticks = 0
        self.payload = Payload()
        self._prepared: Segment | None = None
        self._queue: list[tuple[FloatArray, FloatArray]] = []
        self._segment = -1

    @property
    def identity(self) -> Identity:
        if not self.connected:
            raise RobotConnectionError("not connected")
        return Identity("kinematic", "0", "1", "test")

    @property
    def capabilities(self) -> Capabilities:
        names = tuple(f"j{i + 1}" for i in range(N))
        return Capabilities(names, 125.0, "current", clock="virtual")

    @property
    def limits(self) -> Limits:
        big = np.full(N, 10.0)
        return Limits(-big, big, big, big * 10, big * 10, 5.0)

    def connect(self) -> None:
        self.connected = True

    def set_payload(self, payload: Payload) -> Payload:
        self.calls.append("set_payload")
        self.payload = payload
        return payload

    def prepare(self, segment: Segment) -> None:
        self.calls.append(f"prepare {segment.index}")
        require_within(segment, self.limits)
        self._prepared = segment

    def start(self) -> None:
        self.calls.append("start")
        if self._prepared is None:
            raise CommandRefused("nothing is prepared")
        segment, self._prepared = self._prepared, None
        self._segment = segment.index
        if segment.kind != "hold":
            self._queue = list(zip(segment.q, segment.qd, strict=True))

    def read(self, timeout_s: float = 1.0) -> StructArray:
        if not self.connected:
            raise RobotConnectionError("not connected")
        block = np.zeros(BLOCK, dtype=state_dtype(N))
        for row in block:
            self.ticks += 1
            row["device_time"] = row["host_time"] = self.ticks / 125.0
            row["segment"], row["temperature"] = self._segment, 25.0
            row["status"] = Status.MOVING if self._queue else Status.HOLDING
            if self._queue:
                self.q, row["qd"] = self._queue.pop(0)
            row["q"] = row["q_target"] = self.q
        self.disturb(block)
        return block

    def stop(self) -> None:
        self.calls.append("stop")
        self._queue = []

    def close(self) -> None:
        self.calls.append("close")
        self.connected = False
