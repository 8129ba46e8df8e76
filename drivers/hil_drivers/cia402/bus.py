"""Interface between the driver and its field bus.

The driver implements the object dictionary of CiA 402 (`objects`) and the state machine (`axis`).
In each cycle the driver sends one record of set-points to all drives and receives one record of
measurements (`mapping`). A `Bus` transports both. The only implemented field bus is CAN
(`can_bus`). EtherCAT drives have the same objects (CoE) and exchange the same records as process
data. Support for EtherCAT therefore needs only a further implementation of the protocols of this
module (docs/how-to/drive-can-drives.md).

A bus has two interfaces, because two kinds of threads use the bus:

- `Acyclic` reads and writes objects, one request at a time, and can block. The thread that owns the
  cycles never calls `Acyclic`.
- `Cyclic` exchanges process data and collects all other messages of the drives (`News`). Only the
  thread that owns the cycles calls `Cyclic`, and no method of `Cyclic` waits longer than its time
  argument permits.

Answers to acyclic requests arrive on the same bus as the process data. Therefore a thread must
receive frames while an object is read: the cycle thread, or the thread of `pumping` if no cycles
run.
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
"""Time without a message from the master after which each drive must stop by itself [ms].

Every implementation of the bus configures the drives with this time-out.
"""

ByteArray: TypeAlias = NDArray[np.uint8]
"""Array of bytes with the data of PDOs, as transferred on the wire."""


@dataclass(slots=True)
class Outputs:
    """Commands to the drives in one cycle: lists of raw integers with one value per axis.

    Attributes:
        controlword: Controlwords (6040h). The drives get only the values that are in the mapping.
        mode: Requested modes of operation (6060h).
        target_position: Target positions (607Ah) [increments].
        target_velocity: Target velocities (60FFh) [counts of velocity].
        target_torque: Target torques (6071h) [‰ of rated torque].
        torque_offset: Feed-forward torques (60B2h) [‰ of rated torque].
        segment: Number of the plan's step that the master announces with the commands; −1 for none.
        status: `Status` bits that the master announces with the commands.
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
        """Return outputs that command no voltage, no mode and no motion."""
        return cls([0] * n, [0] * n, [0] * n, [0] * n, [0] * n, [0] * n)


@dataclass(slots=True)
class Inputs:
    """Answers of the drives in one cycle: lists of raw integers with one value per axis.

    Attributes:
        statusword: Statuswords (6041h). All values of objects that are not in the mapping remain 0.
        position: Measured positions (6064h) [increments].
        mode_display: Active modes of operation (6061h).
        velocity: Measured velocities (606Ch) [counts of velocity].
        torque: Measured torques (6077h) [‰ of rated torque].
        current: Measured motor currents (6078h) [‰ of rated current].
        fresh: Whether all PDOs of an axis arrived in this cycle; if False, the values of the axis
            are from an earlier cycle.
        late: Whether an axis that is not fresh has answered earlier SYNCs since the last cycle.
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
        """Return the inputs that apply before the first cycle: zeros, and no axis has answered."""
        return cls([0] * n, [0] * n, [0] * n, [0] * n, [0] * n, [0] * n, [False] * n, [False] * n)


@dataclass(frozen=True, slots=True)
class Emergency:
    """Emergency message (EMCY) with which a drive reports an error.

    Attributes:
        axis: Number of the axis, from 0.
        code: Error code; 0 if the drive reports that all errors are gone.
        register: Error register (1001h).
        data: Five bytes of manufacturer-specific data.
    """

    axis: int
    code: int
    register: int
    data: bytes

    def __str__(self) -> str:
        """Return the error code and the data of the message as text, without the axis."""
        if self.code == 0:
            return "errors reset (0000h)"
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
    """Messages, other than process data, that were received since the last call.

    Attributes:
        emergencies: EMCY messages in the order of their arrival.
        booted: Axes whose drive has restarted.
        silent: Axes whose heartbeat is overdue.
        bus_error: Text that describes why the bus cannot send or receive; empty if the bus works.
    """

    emergencies: list[Emergency] = field(default_factory=list)
    booted: list[int] = field(default_factory=list)
    silent: list[int] = field(default_factory=list)
    bus_error: str = ""

    @property
    def any(self) -> bool:
        """Whether the news contain at least one message."""
        return bool(self.emergencies or self.booted or self.silent or self.bus_error)


@dataclass(frozen=True, slots=True)
class Setting:
    """Value that the driver writes to one object of a drive during configuration.

    Attributes:
        entry: Object.
        value: Required value.
        needed: Whether a drive without the object is rejected.
    """

    entry: Entry
    value: int
    needed: bool = True


class Acyclic(Protocol):
    """Access to the objects and communication states of the drives by methods that can block.

    Axes are numbered from 0, in the order of the joints.
    """

    @property
    def n(self) -> int:
        """Number of axes."""

    def name_of(self, axis: int) -> str:
        """Return the name of an axis for messages, from its joint and its address on the bus."""

    def upload(self, axis: int, entry: Entry) -> int:
        """Read an object.

        Raises:
            CommandRefused: The drive has aborted the transfer; the message contains axis, object
                and abort code.
            RobotTimeout: The drive has not answered the request.
        """

    def download(self, axis: int, entry: Entry, value: int) -> None:
        """Write an object of a drive; raise the same exceptions as `upload`."""

    def upload_each(
        self, entry: Entry, axes: Iterable[int], within_s: float = 0.0
    ) -> dict[int, int]:
        """Read the same object of several drives at the same time; never raise.

        Returns:
            Value for each axis whose drive has answered within `within_s` [s], which is the time
            for all axes together.
        """

    def download_each(
        self, entry: Entry, value: int, axes: Iterable[int], within_s: float = 0.0
    ) -> list[int]:
        """Write the same object of several drives at once; return the axes that confirmed."""

    def settings(self, options: Options, of_drive: Sequence[Setting]) -> list[Setting]:
        """Return the settings of a drive and of the bus, in the order of writing."""

    def unwatch(self, axes: Sequence[int], within_s: float) -> None:
        """Switch the monitoring of the master off in the drives of some axes; never raise."""

    def preoperational(self) -> None:
        """Bring all drives into the state in which they can be configured; raise `RobotTimeout`."""

    def map(self, mapping: Mapping) -> None:
        """Configure the process data of all drives and read back the configuration.

        Raises:
            CommandRefused: A drive does not accept the mapping.
        """

    def operational(self) -> None:
        """Start the exchange of process data in all drives; raise `RobotTimeout`."""

    def release(self) -> None:
        """End the exchange of process data without waiting for a confirmation."""


class Cyclic(Protocol):
    """Cyclic exchange of process data, and messages beside them; used by one thread."""

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """Execute one cycle: send the commands and receive the answers.

        Args:
            outputs: Commands to the drives, which apply these commands when the next cycle begins.
            give_up_s: Latest end of the wait for answers [s, `time.monotonic`]; after that time the
                method returns with the answers received so far.

        Raises:
            RobotConnectionError: The connection to the bus is lost.
        """

    def idle(self, until_s: float) -> None:
        """Handle received frames between two exchanges, until a time of `time.monotonic` [s]."""

    def pump(self, until_s: float) -> None:
        """Handle received frames while no cycles run; device time advances with wall time."""

    def news(self) -> News | None:
        """Return the messages received since the last call; None if no message was received."""

    def watch(self, on: bool) -> None:
        """Start or stop reporting drives that fall silent or restart as news."""

    @property
    def cycle(self) -> int:
        """Number of the last exchange, from 0; −1 before the first one."""

    @property
    def sync_time(self) -> float:
        """Unix time at which the last exchange of process data began [s]."""

    @property
    def synced_s(self) -> float:
        """Time of `time.monotonic` at which the last exchange began [s]; this clock never jumps."""

    @property
    def sent(self) -> ByteArray:
        """(R, n, 8) command bytes of the last exchange; the next exchange overwrites the array."""

    @property
    def answered(self) -> ByteArray:
        """(T, n, 8) answer bytes of the last exchange, with older bytes for missing answers.

        The next exchange overwrites the array.
        """


class Bus(Protocol):
    """Connection to a field bus, open from its construction to `close`."""

    @property
    def acyclic(self) -> Acyclic:
        """Access to the objects of the drives; works only while cycles run or in `pumping`."""

    @property
    def cyclic(self) -> Cyclic:
        """Access to the process data of the drives."""

    @property
    def celsius(self) -> FloatArray:
        """(n,) newest motor temperatures [°C], updated in place; NaN before the first value."""

    def load(self) -> Finding:
        """Return the preflight finding whether the bus has the capacity for the cycles."""

    def losses(self) -> str:
        """Return a text about the frames lost so far; empty if no frame was lost."""

    def flush(self) -> None:
        """Write the queued frames to the log of the bus; the call can wait for a disk."""

    def close(self) -> None:
        """Close the connection to the bus; never raise."""


AT_ONCE_S = 0.02


@contextmanager
def pumping(cyclic: Cyclic) -> Iterator[None]:
    """Handle received frames in a separate thread while the `with` block runs.

    Raises:
        RobotConnectionError: The connection to the bus is lost; this error replaces any error that
            the `with` block raised because of the lost bus.
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
