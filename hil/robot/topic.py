"""A recorded topic: one numpy dtype that is also its ROS 2 message definition."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.core import RecordingError, StructArray
from hil.robot.cdr import ROS_OF_NUMPY, cdr_problem
from hil.robot.state import STATE_SCHEMA_VERSION, state_dtype

STATE_TOPIC = "/robot/state"

TARGET_TOPIC = "/robot/torque_target"
"""The controller's own torques beside its current commands, where both were logged."""

_MESSAGE_NAME = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")


@dataclass(frozen=True)
class Topic:
    """What is recorded under one name, and how to read it years later.

    Attributes:
        name: Topic name, such as `/robot/state` or `/can/raw`.
        dtype: Packed little-endian record; its first fields are `device_time` and `host_time`,
            both float64 [s].
        rate_hz: Nominal sample rate by the device clock [Hz]; gaps are judged against it.
        clock: Which clock `device_time` counts: `controller`, `virtual`, `host`, …
        units: Field name → unit, as text; fields without a unit are left out.
        schema_name: ROS 2 message name, `package/msg/Name`.
        schema_version: Raised when a field changes its meaning; see decision record 0002.

    Raises:
        RecordingError: The dtype is no CDR message, or a name is not one ROS 2 accepts.
    """

    name: str
    dtype: np.dtype[Any]
    rate_hz: float
    clock: str
    units: Mapping[str, str] = field(default_factory=dict)
    schema_name: str = "hil/msg/Record"
    schema_version: int = 1

    def __post_init__(self) -> None:
        if problem := self._problem():
            raise RecordingError(f"topic {self.name}: {problem[0]}", hint=problem[1])

    def _problem(self) -> tuple[str, str] | None:
        if problem := cdr_problem(self.dtype):
            return problem, "order the fields by size: float64 first, then int32, then smaller"
        names = self.dtype.names or ()
        times = [("device_time", "<f8"), ("host_time", "<f8")]
        if [(name, self.dtype[name].str) for name in names[:2]] != times:
            return "the record lacks its times", "begin it with float64 device_time and host_time"
        if not 0 < self.rate_hz < math.inf:
            return f"the rate {self.rate_hz} Hz is no rate", "give the nominal sample rate"
        if not _MESSAGE_NAME.fullmatch(self.schema_name):
            return f"{self.schema_name!r} is no ROS 2 message name", "use package/msg/Name"
        if unknown := set(self.units) - set(names):
            return f"units name unknown fields {sorted(unknown)}", f"it has {', '.join(names)}"
        return None

    @property
    def schema_text(self) -> str:
        """The ROS 2 message definition, one field a line with its unit as a comment."""
        return "".join(self._schema_line(name) for name in self.dtype.names or ())

    def _schema_line(self, name: str) -> str:
        base, shape = self.dtype[name].base, self.dtype[name].shape
        array = f"[{shape[0]}]" if shape else ""
        unit = f"  # {self.units[name]}" if name in self.units else ""
        return f"{ROS_OF_NUMPY[base.str]}{array} {name}{unit}\n"

    @property
    def channel_metadata(self) -> dict[str, str]:
        """What the MCAP channel says about the topic: version, rate, clock, units."""
        return {
            "schema_version": str(self.schema_version),
            "rate_hz": repr(float(self.rate_hz)),
            "clock": self.clock,
            **{f"unit.{name}": unit for name, unit in self.units.items()},
        }

    def blank(self, rows: int) -> StructArray:
        """Rows in which nothing is known yet: NaN in floating-point fields, 0 in integers."""
        block = np.zeros(rows, self.dtype)
        for name in self.dtype.names or ():
            if self.dtype[name].base.kind == "f":
                block[name] = np.nan
        return block


def state_topic(n_joints: int, rate_hz: float, *, clock: str, effort_unit: str) -> Topic:
    """The base robot record of an arm with `n_joints` joints.

    Args:
        n_joints: Number of joints n.
        rate_hz: Rate of the state samples [Hz].
        clock: Which clock `device_time` counts.
        effort_unit: `A` or `N·m`, for `effort` and `effort_target`.
    """
    units = {
        "device_time": "s", "host_time": "s (Unix time)",
        "q": "rad", "qd": "rad/s", "effort": effort_unit, "temperature": "°C",
        "q_target": "rad", "qd_target": "rad/s", "qdd_target": "rad/s^2",
        "effort_target": effort_unit,
    }  # fmt: skip
    return Topic(
        name=STATE_TOPIC,
        dtype=state_dtype(n_joints),
        rate_hz=rate_hz,
        clock=clock,
        units=units,
        schema_name=f"hil/msg/State{n_joints}",
        schema_version=STATE_SCHEMA_VERSION,
    )


def torque_target_topic(n_joints: int, rate_hz: float, *, clock: str) -> Topic:
    """What a controller that commands currents takes for its torques, row by row of the state.

    Args:
        n_joints: Number of joints n.
        rate_hz: Rate of the samples [Hz].
        clock: Which clock `device_time` counts.
    """
    fields: list[Any] = [("device_time", "<f8"), ("host_time", "<f8")]
    return Topic(
        name=TARGET_TOPIC,
        dtype=np.dtype([*fields, ("torque_target", "<f8", (n_joints,))]),
        rate_hz=rate_hz,
        clock=clock,
        units={"device_time": "s", "host_time": "s (Unix time)", "torque_target": "N·m"},
        schema_name=f"hil/msg/TorqueTarget{n_joints}",
    )
