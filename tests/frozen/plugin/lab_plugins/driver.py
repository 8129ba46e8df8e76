"""A driver of an arm without physics: it goes where it is told; its torque is like gravity's."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.arms import Payload, load_arm
from hil.core import CommandRefused, RobotConnectionError, SpecError
from hil.robot import Capabilities, Identity, Limits, Segment, Status, state_dtype

BLOCK = 16


class LabArm:
    """Set-points become measurements on a virtual clock."""

    def __init__(self, name: str, model: str, *, offset_nm: float = 0.0) -> None:
        if not isinstance(offset_nm, int | float):
            raise SpecError("offset_nm must be a number of N·m")
        self._name, self._arm, self._offset = name, load_arm(model), float(offset_nm)
        self._connected = False
        self._ticks = 0
        self._segment = -1
        self._prepared: Segment | None = None
        self._q = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
        self._rows: list[Any] = []

    @property
    def identity(self) -> Identity:
        if not self._connected:
            raise RobotConnectionError(f"{self._name} is not connected")
        return Identity(self._arm.name, "lab-1", "1.0", "lab-arm")

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(tuple(self._arm.joint_names), 50.0, "torque", clock="virtual")

    @property
    def limits(self) -> Limits:
        arm = self._arm
        return Limits(
            arm.q_min, arm.q_max, arm.qd_max, arm.qdd_max, arm.effort_max, arm.payload_max_kg
        )

    def connect(self) -> None:
        self._connected = True

    def set_payload(self, payload: Payload) -> Payload:
        return payload

    def prepare(self, segment: Segment) -> None:
        if (np.abs(segment.qd) > self.limits.qd_max * 1.001).any():
            raise CommandRefused(f"segment {segment.index} is too fast")
        self._prepared = segment

    def start(self) -> None:
        if self._prepared is None:
            raise CommandRefused("nothing is prepared")
        segment, self._prepared = self._prepared, None
        self._segment = segment.index
        if segment.kind != "hold":
            self._rows = list(zip(segment.q, segment.qd, segment.qdd, strict=True))

    def read(self, timeout_s: float = 1.0) -> Any:
        if not self._connected:
            raise RobotConnectionError(f"{self._name} is not connected")
        block = np.zeros(BLOCK, dtype=state_dtype(len(self._q)))
        for row in block:
            self._ticks += 1
            row["device_time"] = row["host_time"] = self._ticks / 50.0
            row["segment"], row["temperature"] = self._segment, 25.0
            row["status"] = Status.MOVING if self._rows else Status.HOLDING
            if self._rows:
                self._q, row["qd"], row["qdd_target"] = self._rows.pop(0)
                row["qd_target"] = row["qd"]
            row["q"] = row["q_target"] = self._q
            row["effort"] = 5.0 * np.cos(self._q) + self._offset
        return block

    def stop(self) -> None:
        self._rows = []

    def close(self) -> None:
        self.stop()
        self._connected = False
