"""Drivers that misbehave on request, loaded by a driver's process as `process_drivers:WallArm`."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, RobotConnectionError, RobotFault
from hil.core.typing import FloatArray, StructArray
from hil.robot import Capabilities, Identity, Limits, Segment, Status, state_dtype
from tests.support.kinematic_robot import KinematicRobot, require_within

N = 3
BRAKING_S = 0.1


class Kinematic(KinematicRobot):
    """The tests' robot without physics, made the way drivers are."""

    def __init__(self, name: str, model: str, *, answer: str = "") -> None:
        super().__init__()
        self.answer = answer

    def set_payload(self, payload: Payload) -> Payload:
        if self.answer == "fault":
            raise JointOnFire("joint 3 burns", hint="extinguish it")
        if self.answer == "bug":
            raise ZeroDivisionError("a bug")
        if self.answer == "exit":
            sys.exit("a vendor's library gives up")
        if self.answer == "print":
            for _ in range(20_000):
                os.write(2, b"a vendor's library complains at length\n")
            print("the end")  # noqa: T201
        return super().set_payload(payload)


class WithSlider(Kinematic):
    """Reports the speed slider of its controller, which is lowered with the first read."""

    speed_scaling = float("nan")

    def read(self, timeout_s: float = 1.0) -> StructArray:
        self.speed_scaling = 0.7
        return super().read(timeout_s)


class JointOnFire(RobotFault):
    """A class of errors that only the driver knows."""


class WithTopics(Kinematic):
    """Opts into what drivers may opt into."""

    raw = np.dtype([("device_time", "<f8"), ("host_time", "<f8"), ("ticks", "<i4", (2,))])
    resource = "bench://7"

    @property
    def topics(self) -> Sequence[Any]:
        from hil.robot.state import Topic  # takes longer than all the rest of this file

        return (Topic("/raw", self.raw, 125.0, "virtual", {"device_time": "s"}),)

    def drain(self) -> Mapping[str, StructArray]:
        rows = np.zeros(2, self.raw)
        rows["ticks"] = [[1, 2], [3, self.ticks]]
        return {"/raw": rows}


class Environment(Kinematic):
    """Says what it was started with."""

    @property
    def identity(self) -> Identity:
        path = os.environ.get("PYTHONPATH", "")
        return Identity("kinematic", "0", "1", "test", {"PYTHONPATH": path})


class WallArm:
    """An arm in wall time that goes exactly where it is told, and writes down what it is told.

    `hang` names a member that never returns; `hold` one that never gives the interpreter back.
    """

    def __init__(
        self,
        name: str,
        model: str,
        *,
        journal: str = os.devnull,
        rate_hz: float = 100.0,
        hang: Sequence[str] = (),
        hold: Sequence[str] = (),
        spawns: bool = False,
        late_s: float = 0.0,
        babbles: bool = False,
        crashes: str = "",
    ) -> None:
        self.resource = f"process-drivers://{name}"
        self._journal = Path(journal)
        self._rate, self._hang, self._hold, self._spawns = rate_hz, hang, hold, spawns
        self._late_s, self._babbles = late_s, babbles
        self._crashes = crashes
        self._lock = threading.Lock()
        self._connected = False
        self._began = time.monotonic()
        self._tick = 0
        self._path: FloatArray = np.zeros((1, N))
        self._cursor, self._segment = 1, -1
        self._prepared: Segment | None = None

    @property
    def identity(self) -> Identity:
        self._require()
        return Identity("wall-arm", "7", "1", "test", {"pid": str(os.getpid())})

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(("a", "b", "c"), self._rate, "torque")

    @property
    def limits(self) -> Limits:
        big = np.full(N, 10.0)
        return Limits(-big, big, big, big * 10, big * 10, 5.0)

    def connect(self) -> None:
        self._misbehave("connect")
        if self._spawns:
            subprocess.Popen(["sleep", "20"], close_fds=False)
        self._connected = True

    def set_payload(self, payload: Payload) -> Payload:
        self._misbehave("set_payload")
        return payload

    def prepare(self, segment: Segment) -> None:
        self._require()
        require_within(segment, self.limits)
        self._prepared = segment

    def start(self) -> None:
        self._require()
        if self._prepared is None:
            raise CommandRefused("nothing is prepared")
        with self._lock:
            segment, self._prepared = self._prepared, None
            self._path, self._cursor, self._segment = segment.q, 0, segment.index
        self._note("start")

    def read(self, timeout_s: float = 1.0) -> StructArray:
        self._require()
        self._misbehave("read")
        if self._babbles:
            os.write(int(sys.argv[1]), b"a library that writes where it should not")
        late_s, self._late_s = self._late_s, 0.0
        time.sleep(late_s)
        while (due := int((time.monotonic() - self._began) * self._rate)) <= self._tick:
            time.sleep((self._tick + 1) / self._rate - (time.monotonic() - self._began))
        with self._lock:
            rows = [self._row(tick) for tick in range(self._tick + 1, due + 1)]
            self._tick = due
        return np.array(rows, dtype=state_dtype(N))

    def stop(self) -> None:
        self._note("stop")
        self._misbehave("stop")
        with self._lock:
            if self._cursor >= len(self._path):
                return
            q, after = (
                self._path[self._cursor],
                self._path[min(self._cursor + 1, len(self._path) - 1)],
            )
            steps = max(1, int(BRAKING_S * self._rate))
            pace = np.cumsum(np.linspace(1, 0, steps))[:, None]
            self._path, self._cursor = q + (after - q) * pace, 0

    def close(self) -> None:
        self._note("close")
        self._misbehave("close")
        self._connected = False

    def client_gone(self) -> None:
        self._note("client_gone")

    def _row(self, tick: int) -> Any:
        moving = self._cursor < len(self._path)
        row = np.zeros((), dtype=state_dtype(N))
        row["device_time"], row["host_time"] = tick / self._rate, time.time()
        before = self._path[max(min(self._cursor, len(self._path)) - 1, 0)]
        self._cursor += moving
        q = self._path[min(self._cursor, len(self._path)) - 1]
        row["q"] = row["q_target"] = q
        row["qd"] = (q - before) * self._rate
        row["segment"] = self._segment
        moving = self._cursor < len(self._path)
        row["status"] = Status.MOVING if moving else Status.HOLDING
        return row

    def _require(self) -> None:
        if not self._connected:
            raise RobotConnectionError("not connected")

    def _misbehave(self, member: str) -> None:
        if member == self._crashes:
            ctypes.string_at(0)
        if member in self._hang:
            self._note(f"hangs in {member}")
            threading.Event().wait()
        if member in self._hold:
            self._note(f"holds the interpreter in {member}")
            ctypes.PyDLL(None).sleep(60)

    def _note(self, event: str) -> None:
        with self._journal.open("a") as journal:
            journal.write(json.dumps({"t": time.monotonic(), "event": event}) + "\n")


def events(journal: Path) -> dict[str, float]:
    """When each event was last noted, by the monotonic clock [s]."""
    if not journal.exists():
        return {}
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    return {line["event"]: line["t"] for line in lines}
