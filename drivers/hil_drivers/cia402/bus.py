"""The field bus below the driver: what an axis, a supervisor and a commissioning ask of it.

The driver knows the object dictionary of CiA 402 (`objects`), the state machine (`axis`) and a
cycle that carries one record of set-points to all drives and one of measurements back (`mapping`).
How that travels is the business of a `Bus`. There is one today, CAN (`can_bus`); EtherCAT has the
same objects over CoE and the same records as process data, so it is one more class with these
members and nothing above it changes (docs/how-to/drive-can-drives.md).

A bus has two faces, because two kinds of threads use it:

- `Acyclic` reads and writes objects, one request at a time, and may block. The thread that owns the
  cycles never calls it.
- `Cyclic` exchanges process data and collects what comes beside them (`News`). Only the thread that
  owns the cycles calls it, and nothing in it may wait for longer than it was told to.

Answers to acyclic requests arrive on the same bus, so frames have to be taken while an object is
read: by the cycles, or by `pumping` where there are none.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hil.core import FloatArray, HilError
from hil.robot import Finding
from hil_drivers.cia402.mapping import Mapping
from hil_drivers.cia402.objects import Entry, error_text, register_text
from hil_drivers.cia402.options import Options

MASTER_SILENCE_MS = 250
"""Silence of ours after which a drive stops by itself: every bus sets its drives up for that."""

ByteArray: TypeAlias = NDArray[np.uint8]
"""Data of PDOs as they are on the wire."""


@dataclass(slots=True)
class Outputs:
    """Commands to the drives in one cycle: raw integers, one per axis.

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
    """Answers of the drives in one cycle: raw integers, one per axis.

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

    def __str__(self) -> str:
        """Return its content without the axis."""
        if self.code == 0:
            return "errors are gone (0000h)"
        register = register_text(self.register)
        vendors = self.data.hex(" ") if any(self.data) else ""
        beside = [
            f"error register: {register}" if register else "",
            f"data {vendors}" if vendors else "",
        ]
        more = ", ".join(text for text in beside if text)
        return f"{error_text(self.code)}; {more}" if more else error_text(self.code)


@dataclass(slots=True)
class News:
    """Messages beside process data since the last call.

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


@dataclass(frozen=True, slots=True)
class Setting:
    """One object that a drive is to have at some value.

    Attributes:
        entry: Which.
        value: To be written.
        needed: Whether a drive without it is refused.
    """

    entry: Entry
    value: int
    needed: bool = True


class Acyclic(Protocol):
    """Objects of the drives and the states of their communication; blocks.

    Axes are counted from 0, in the order of the joints.
    """

    @property
    def n(self) -> int:
        """Number of axes."""

    def name_of(self, axis: int) -> str:
        """An axis for messages: its joint and its address on the bus."""

    def upload(self, axis: int, entry: Entry) -> int:
        """Read an object.

        Raises:
            CommandRefused: The drive has aborted; the message names axis, object and abort code.
            RobotTimeout: It has not answered.
        """

    def download(self, axis: int, entry: Entry, value: int) -> None:
        """Write an object; raises as `upload`."""

    def upload_each(
        self, entry: Entry, axes: Iterable[int], within_s: float = 0.0
    ) -> dict[int, int]:
        """Read an object of several drives at once; never raises.

        Returns:
            Values by axis, of the drives that have answered within that time [s], all together.
        """

    def download_each(
        self, entry: Entry, value: int, axes: Iterable[int], within_s: float = 0.0
    ) -> list[int]:
        """Write it likewise; returns the axes that have confirmed it in time."""

    def settings(self, options: Options, of_drive: Sequence[Setting]) -> list[Setting]:
        """The settings of a drive with those that this bus needs, in the order of writing."""

    def unwatch(self, axes: Sequence[int], within_s: float) -> None:
        """Have these drives not mind when we leave; never raises."""

    def preoperational(self) -> None:
        """Bring all drives to where they can be configured; raises `RobotTimeout`."""

    def map(self, mapping: Mapping) -> None:
        """Lay out the process data of all drives, and read back that they are so.

        Raises:
            CommandRefused: A drive does not take it.
        """

    def operational(self) -> None:
        """Start the exchange of process data in all drives; raises `RobotTimeout`."""

    def release(self) -> None:
        """End the exchange of process data, without waiting for a confirmation."""


class Cyclic(Protocol):
    """Process data of all drives, and the messages beside them; called by one thread."""

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """One cycle: the commands go out, the answers come.

        Args:
            outputs: Applied by the drives when the next cycle begins.
            give_up_s: `time.monotonic` at which it returns with what has come.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def idle(self, until_s: float) -> None:
        """Handle frames between two exchanges, until that time of `time.monotonic`."""

    def pump(self, until_s: float) -> None:
        """While there are no exchanges: the same, and device time is the wall's."""

    def news(self) -> News | None:
        """Return messages since the last call; None if there were none."""

    def watch(self, on: bool) -> None:
        """Whether drives that fall silent or start anew are news, from now on."""

    @property
    def cycle(self) -> int:
        """Number of the last exchange, from 0; −1 before."""

    @property
    def sync_time(self) -> float:
        """When it began [s, Unix time]."""

    @property
    def synced_s(self) -> float:
        """The same by `time.monotonic` [s], which never jumps."""

    @property
    def sent(self) -> ByteArray:
        """(R, n, 8) command data that went with it; overwritten by the next exchange."""

    @property
    def answered(self) -> ByteArray:
        """(T, n, 8) answer data, likewise; data of an earlier cycle where none came."""


class Bus(Protocol):
    """One end of a field bus, open from its construction to `close`."""

    @property
    def acyclic(self) -> Acyclic:
        """Objects of the drives; answered while cycles go on, or while it is pumped."""

    @property
    def cyclic(self) -> Cyclic:
        """Their process data."""

    @property
    def celsius(self) -> FloatArray:
        """(n,) newest temperatures of the motors [°C], NaN before; the bus writes into it."""

    def load(self) -> Finding:
        """Whether the cycles fit onto this bus, with the figures."""

    def losses(self) -> str:
        """Return losses of frames so far, in words; empty if there were none."""

    def flush(self) -> None:
        """Write the log of the bus; called by a thread that may wait for a disk."""

    def close(self) -> None:
        """Leave the bus; never raises."""


AT_ONCE_S = 0.02


@contextmanager
def pumping(cyclic: Cyclic) -> Iterator[None]:
    """Handle frames that come, in a thread, while the block runs.

    Raises:
        RobotConnectionError: The bus is gone; in place of whatever came of that in the block.
    """
    over, gone = threading.Event(), list[HilError]()

    def pump() -> None:
        try:
            while not over.is_set():
                cyclic.pump(time.monotonic() + AT_ONCE_S)
        except HilError as error:
            gone.append(error)

    thread = threading.Thread(target=pump, name="hil-can-pump", daemon=True)
    thread.start()
    try:
        yield
    except HilError as error:
        raise (gone or [error])[0] from error
    finally:
        over.set()
        thread.join()
    if gone:
        raise gone[0]
