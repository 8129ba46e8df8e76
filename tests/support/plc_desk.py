"""A PLC on the desk: the mock's program and memory in this process, without a socket.

Cycles pass with every request of the driver's, so that nothing waits for a clock.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyads
import pytest
from pyads import constants, structs

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.robot import Segment
from hil_drivers.twincat import ads as lines
from hil_drivers.twincat import controller as controllers
from hil_drivers.twincat.options import options_of
from hil_drivers.twincat.robot import TwinCatRobot
from hil_mock_robot.twincat.ads import PlcHandler, Refused
from hil_mock_robot.twincat.arm import Measured
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.program import PlcProgram

CYCLES = 20
"""That pass with each request."""

TIMED_OUT = 0x745


class ObedientArm:
    """Is where its set-points are, but `sags_rad` lower where its brakes have held it."""

    def __init__(self) -> None:
        self.published, self.declared = load_arm("lab6"), Payload()
        self.setpoint, self.braked, self.sags_rad = np.zeros((3, 6)), False, 0.0

    def advance(self, setpoints: Any) -> Measured:
        self.setpoint = setpoints[-1].copy()
        q, qd, zero = setpoints[:, 0], setpoints[:, 1], np.zeros((len(setpoints), 6))
        q = q - self.sags_rad * self.braked
        return Measured(q, qd, zero, zero, zero, qd, 0)

    def brake(self) -> None:
        self.braked = True

    def release(self) -> None:
        self.setpoint = self.setpoint - np.array([self.sags_rad, 0, 0])[:, None] * self.braked
        self.braked = False

    def declare(self, payload: Payload) -> None:
        self.declared = payload


class Desk:
    """The PLC.

    Attributes:
        mute: Commands whose answers the driver never sees.
        silent: Whether requests run into their time-out.
        codes: (group, code): the next request to that index group gets this return code.
        writes: (group, offset, bytes) in order.
        local: What `set_local_address` was called with.
    """

    def __init__(self) -> None:
        self.memory, self.arm = Memory(), ObedientArm()
        self.fill_info()
        self.program = PlcProgram(self.memory, self.arm)  # type: ignore[arg-type]
        self.handler = PlcHandler(self.memory, 851)
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.program.listeners.append(lambda event, details: self.events.append((event, details)))
        self.silent, self.stands = False, False
        self.codes: list[tuple[int, int]] = []
        self.writes: list[tuple[int, int, bytes]] = []
        self.timeouts: list[int] = []
        self.local: list[str] = []
        self._one = threading.RLock()

    def fill_info(self) -> None:
        info, arm = self.memory.view("stInfo")[0], load_arm("lab6")
        info["fCycleS"], info["fWatchdogS"], info["fStopRadS2"] = 0.001, 0.3, 8.0
        info["fPayloadMax"], info["nAxes"], info["nEffort"] = 5.0, 6, 1
        info["aQMin"], info["aQMax"] = arm.q_min, arm.q_max
        info["aQdMax"], info["aQddMax"] = arm.qd_max, arm.qdd_max
        info["nRingRows"] = len(self.memory.view("aRing"))
        info["nSetPoints"] = len(self.memory.view("aSetPoints"))

    def asked(self, command: int, group: int, data: bytes) -> bytes:
        """One request; cycles pass."""
        with self._one:
            if self.silent:
                raise pyads.ADSError(err_code=TIMED_OUT)
            if self.codes and self.codes[0][0] == group:
                raise pyads.ADSError(err_code=self.codes.pop(0)[1])
            try:
                answer = self.handler.serve(command, data)
            except Refused as refused:
                raise pyads.ADSError(err_code=refused.code) from refused
            if not self.stands:
                self.program.cycles(CYCLES)
            return answer

    def told(self, event: str) -> list[dict[str, Any]]:
        """What the program has told of one kind."""
        return [details for each, details in self.events if each == event]


class DeskConnection:
    """What the driver uses of `pyads.Connection`."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk

    def open(self) -> None: ...

    def close(self) -> None: ...

    def set_timeout(self, ms: int) -> None:
        self._desk.timeouts.append(ms)

    def read_state(self) -> tuple[int, int]:
        answer = self._desk.asked(constants.ADSCOMMAND_READSTATE, 0, b"")
        return struct.unpack("<HH", answer)

    def read_device_info(self) -> Any:
        return "desk", SimpleNamespace(version=3, revision=1, build=1)

    def read(self, group: int, offset: int, kind: Any, return_ctypes: bool = False) -> Any:
        data = struct.pack("<III", group, offset, ctypes.sizeof(kind))
        return kind.from_buffer_copy(self._desk.asked(constants.ADSCOMMAND_READ, group, data)[4:])

    def write(self, group: int, offset: int, value: Any, kind: Any) -> None:
        data = bytes(value)
        head = struct.pack("<III", group, offset, len(data))
        self._desk.asked(constants.ADSCOMMAND_WRITE, group, head + data)
        self._desk.writes.append((group, offset, data))

    def read_write(
        self, group: int, offset: int, kind: Any, value: Any, _: Any, return_ctypes: bool = False
    ) -> Any:
        given = value.encode() + b"\0" if isinstance(value, str) else bytes(value)
        head = struct.pack("<IIII", group, offset, 0, len(given))
        answer = self._desk.asked(constants.ADSCOMMAND_READWRITE, group, head + given)[4:]
        if kind is structs.SAdsSymbolEntry:
            return kind.from_buffer_copy(answer.ljust(ctypes.sizeof(kind), b"\0"))
        return answer if kind is None else struct.unpack("<I", answer)[0]


@contextmanager
def on_the_desk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    """The driver's lines lead to the desk."""
    desk = Desk()
    library = SimpleNamespace(
        Connection=lambda *_: DeskConnection(desk),
        ADSError=pyads.ADSError,
        set_local_address=desk.local.append,
    )
    monkeypatch.setattr(lines, "library", lambda: library)
    monkeypatch.setattr(controllers, "listening_address", lambda _: "desk")
    yield desk


def line_to(**options: Any) -> lines.Line:
    """A line to the PLC on the desk, opened."""
    line = lines.Line(options_of({"address": "127.0.0.1"} | options, "lab6"), 1.0)
    line.open("desk")
    return line


def desk_robot(**options: Any) -> TwinCatRobot:
    """The driver; it does not wait for blocks."""
    return TwinCatRobot("arm", "lab6", address="127.0.0.1", block_rows=1, **options)


def little_move(start: float = 0.0, way: float = 0.05, n: int = 400, index: int = 1) -> Segment:
    """Every joint from `start` on, at rest at both ends."""
    t = np.arange(n)[:, None] / (n - 1) * np.ones(6)
    w = np.pi / ((n - 1) * 1e-3)
    q = start + way / 2 * (1 - np.cos(np.pi * t))
    qd, qdd = way / 2 * w * np.sin(np.pi * t), way / 2 * w**2 * np.cos(np.pi * t)
    return Segment(index, "trajectory", q, qd, qdd, float(qd.max()), float(qdd.max()))
