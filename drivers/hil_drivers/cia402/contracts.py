"""What the layers of the driver are to each other; transports other than CAN fit in here.

EtherCAT by `pysoem` has the same objects over CoE and the same record as process data: it is one
`Acyclic` and one `Cyclic` more (docs/how-to/drive-can-drives.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hil_drivers.cia402.mapping import Mapping
from hil_drivers.cia402.objects import Entry

ByteArray: TypeAlias = NDArray[np.uint8]
"""Data of PDOs as they are on the wire."""


@dataclass(slots=True)
class Outputs:
    """What the drives are told in one cycle: raw integers, one per axis.

    Attributes:
        controlword, mode, target_position, target_velocity, target_torque, torque_offset: See
            `hil_drivers.cia402.objects`. What the mapping does not carry is not sent.
        segment, status: What the master announces with them: the plan's step and `Status` bits.
    """

    controlword: list[int]
    mode: list[int]
    target_position: list[int]
    target_velocity: list[int]
    target_torque: list[int]
    torque_offset: list[int]
    segment: int = -1
    status: int = 0

    @classmethod
    def idle(cls, n: int) -> Outputs:
        """Nothing commanded: no voltage, no mode."""
        return cls([0] * n, [0] * n, [0] * n, [0] * n, [0] * n, [0] * n)


@dataclass(slots=True)
class Inputs:
    """What the drives answered in one cycle: raw integers, one per axis.

    Attributes:
        statusword, position, mode_display, velocity, torque, current: See
            `hil_drivers.cia402.objects`. What the mapping does not carry stays 0.
        fresh: Per axis, whether all its PDOs came in this cycle; else its values are older.
        late: Per axis that is not fresh, whether answers to earlier SYNCs have come since the last
            cycle: it is behind.
    """

    statusword: list[int]
    position: list[int]
    mode_display: list[int]
    velocity: list[int]
    torque: list[int]
    current: list[int]
    fresh: list[bool]
    late: list[bool]

    @classmethod
    def none_yet(cls, n: int) -> Inputs:
        """Before the first cycle."""
        return cls([0] * n, [0] * n, [0] * n, [0] * n, [0] * n, [0] * n, [False] * n, [False] * n)


@dataclass(frozen=True, slots=True)
class Emergency:
    """An EMCY message.

    Attributes:
        axis: From 0.
        code: Error code; 0 means that errors are gone.
        register: 1001h.
        data: Five bytes of the vendor's.
    """

    axis: int
    code: int
    register: int
    data: bytes


@dataclass(slots=True)
class News:
    """What came beside process data since it was last asked for.

    Attributes:
        emergencies: In the order in which they came.
        booted: Axes that have started anew.
        silent: Axes whose heartbeat is overdue.
        bus_error: Why nothing can be sent or received any more; empty while that works.
    """

    emergencies: list[Emergency] = field(default_factory=list)
    booted: list[int] = field(default_factory=list)
    silent: list[int] = field(default_factory=list)
    bus_error: str = ""

    @property
    def any(self) -> bool:
        """Whether there is something to look at."""
        return bool(self.emergencies or self.booted or self.silent or self.bus_error)


class Acyclic(Protocol):
    """Objects of the drives, one request at a time; blocks, never called by the cyclic thread."""

    def upload(self, axis: int, entry: Entry) -> int:
        """Read an object.

        Raises:
            CommandRefused: The drive has aborted; the message names axis, object and abort code.
            RobotTimeout: It has not answered.
        """

    def download(self, axis: int, entry: Entry, value: int) -> None:
        """Write an object; raises as `upload`."""

    def preoperational(self) -> None:
        """Bring all drives to where they can be configured; raises `RobotTimeout`."""

    def operational(self) -> None:
        """Start the exchange of process data in all drives."""

    def map(self, mapping: Mapping) -> None:
        """Lay out the process data of all drives, and read back that they are so.

        Raises:
            CommandRefused: A drive does not take it.
        """


class Cyclic(Protocol):
    """Process data of all drives; called by one thread."""

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """One cycle: SYNC, commands, answers.

        Args:
            outputs: Applied by the drives at the next SYNC.
            give_up_s: `time.monotonic` at which it returns with what has come.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def idle(self, until_s: float) -> None:
        """Between two exchanges: take what comes until that time of `time.monotonic`."""

    def pump(self, until_s: float) -> None:
        """While there are no exchanges: the same, and device time is the wall's."""

    def news(self) -> News | None:
        """What has come since the last call; None when nothing has."""

    def watch(self, on: bool) -> None:
        """Whether overdue heartbeats and boot-ups of the drives are news, from now on."""

    @property
    def cycle(self) -> int:
        """Number of the last SYNC, from 0; −1 before."""

    @property
    def sync_time(self) -> float:
        """When it was sent [s, Unix time]."""

    @property
    def synced_s(self) -> float:
        """The same by `time.monotonic` [s], which never jumps."""

    @property
    def sent(self) -> ByteArray:
        """(R, n, 8) command data that went with it; overwritten by the next exchange."""

    @property
    def answered(self) -> ByteArray:
        """(T, n, 8) answer data, likewise; where none came, what was there before."""
