"""ADS connections to a PLC: transfer of variables as bytes, and conversion of errors.

`listening_address` finds the PLC's ADS port by TCP, before any ADS connection is opened. `Line` is
the connection from one ADS port of this computer to the PLC. On Linux `pyads` contains an ADS
router, so this computer needs no TwinCAT. The PLC needs a route back to this computer. Requests of
one ADS port are executed one after the other, so urgent requests use a separate line. All lines to
one PLC share one TCP connection. `pyads` deletes the route to the PLC when any line is closed.
Before the driver opens new lines to a PLC, it therefore closes all old lines.

`error_of` converts ADS return codes to exceptions of `hil`, one class for each remedy. The error
types of `pyads` do not distinguish a missing route, a runtime that is not running, and a program
that was changed online.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from hil.core import (
    CommandRefused,
    HilError,
    PluginError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
)
from hil_drivers.network import peer_of, reason
from hil_drivers.twincat.options import Options

CONNECTED_WITHIN_S = 3.0
"""Longest wait for a TCP connection [s]; `pyads` itself would wait for minutes."""


def listening_address(options: Options) -> str:
    """Return the address for `Line.open` after a test that a TCP server listens at the address.

    Raises:
        RobotConnectionError: No TCP server listens at the address.
    """
    host, port = options.host
    try:
        return f"{peer_of(host, port, CONNECTED_WITHIN_S)}:{port}"
    except OSError as error:
        raise RobotConnectionError(
            f"PLC {options.address}: no connection to port {port}: {reason(error)}",
            hint="check that the PLC is on, that its address is right, and that its firewall opens "
            "TwinCAT's ADS port 48898; start the mock with: hil mock plc",
        ) from error


def library() -> Any:
    """Import and return the module `pyads`.

    Raises:
        PluginError: `pyads` is not installed, or does not work on this computer.
    """
    try:
        import pyads
    except (ImportError, OSError) as error:
        raise PluginError(
            f"the driver twincat needs pyads: {error}", hint='pip install "hil[ads]"'
        ) from error
    return pyads


HANDLE_BY_NAME, VALUE_BY_HANDLE, RELEASE_HANDLE = 0xF003, 0xF005, 0xF006
INFO_BY_NAME, SUM_READ = 0xF009, 0xF080
"""Index groups of the ADS services for handles and symbols."""


@dataclass(frozen=True, slots=True)
class Place:
    """Address of a variable in the memory of the PLC.

    Attributes:
        group: ADS index group; the group for handles if `offset` is a handle.
        offset: ADS index offset, or the handle of the variable.
        size: Size of the variable [bytes].
    """

    group: int
    offset: int
    size: int


VERSION = Place(0xF008, 0, 1)
"""Address of the PLC's symbol version, which changes with every online change."""

RUN = 5

STATES = {2: "RESET", 3: "INIT", 4: "START", 5: "RUN", 6: "STOP", 11: "ERROR", 15: "CONFIG"}
"""Names of the ADS states of a PLC runtime."""

ROUTE = (
    "add a route to this computer on the PLC (TwinCAT: System, Routes), and check that ams_net_id "
    "is that of the PLC"
)


class Line:
    """ADS port of this computer, connected to an ADS port of the PLC.

    Args:
        options: Options of the arm.
        timeout_s: Longest wait for an answer of the PLC [s].
    """

    def __init__(self, options: Options, timeout_s: float) -> None:
        self._options, self._timeout_s = options, timeout_s
        self._connection: Any = None
        self._answered = False

    @property
    def where(self) -> str:
        """Name of the PLC for messages."""
        return f"PLC {self._options.address} (AMS {self._options.ams_net_id}:{self._options.port})"

    def open(self, address: str) -> None:
        """Open the connection to the PLC.

        Args:
            address: Address from `listening_address`.

        Raises:
            RobotConnectionError: The PLC cannot be reached.
            PluginError: `pyads` is not installed.
        """
        pyads = library()
        self.close()
        options = self._options
        connection = pyads.Connection(options.ams_net_id, options.port, address)
        try:
            if options.local_net_id:
                pyads.set_local_address(options.local_net_id)
            connection.open()
            connection.set_timeout(round(self._timeout_s * 1000))
        except (pyads.ADSError, RuntimeError) as error:
            connection.close()
            raise RobotConnectionError(
                f"{self.where} cannot be reached: {text_of(error)}", hint=ROUTE
            ) from error
        self._connection, self._answered = connection, False

    def close(self) -> None:
        """Close the connection; further calls have no effect."""
        connection, self._connection = self._connection, None
        if connection is not None:
            pyads = library()
            try:
                connection.close()
            except (pyads.ADSError, OSError):
                return

    def state(self) -> int:
        """Read the ADS state of the PLC's runtime; raise the same exceptions as `read`."""
        with self._plain_errors("read its state"):
            return int(self._opened().read_state()[0])

    def device(self) -> str:
        """Read the name and version of the PLC's runtime; raise the same exceptions as `read`."""
        with self._plain_errors("read its name"):
            name, version = self._opened().read_device_info()
            return f"{name} {version.version}.{version.revision}.{version.build}"

    def place(self, name: str) -> Place:
        """Request the address of a variable from the PLC.

        Args:
            name: Qualified name of the variable.

        Raises:
            PluginError: The PLC has no variable of that name.
            RobotError: See `read`.
        """
        from pyads import constants, structs

        with self._plain_errors(f"{LOOK_UP}{name}"):
            entry = self._opened().read_write(
                INFO_BY_NAME, 0, structs.SAdsSymbolEntry, name,
                constants.PLCTYPE_STRING, return_ctypes=True,
            )  # fmt: skip
            return Place(int(entry.iGroup), int(entry.iOffs), int(entry.size))

    def handle(self, name: str) -> Place:
        """Request a handle for writing a variable from the PLC.

        A PLC whose program was changed online rejects an old handle. After such a change, a write
        by an old offset would change other memory of the PLC.

        Raises:
            PluginError: The PLC has no variable of that name.
            RobotError: See `read`.
        """
        from pyads import constants

        size = self.place(name).size
        with self._plain_errors(f"{LOOK_UP}{name}"):
            handle = self._opened().read_write(
                HANDLE_BY_NAME, 0, constants.PLCTYPE_UDINT, name,
                constants.PLCTYPE_STRING,
            )  # fmt: skip
        return Place(VALUE_BY_HANDLE, int(handle), size)

    def release(self, handle: Place) -> None:
        """Release a handle in the PLC; raise the same exceptions as `read`."""
        self.write(Place(RELEASE_HANDLE, 0, 4), handle.offset.to_bytes(4, "little"))

    def version(self) -> int:
        """Read the symbol version of the PLC, which changes with the PLC's program.

        Raises:
            RobotError: See `read`.
        """
        return self.read(VERSION)[0]

    def wait_for(self, timeout_s: float) -> None:
        """Set the longest wait for the answers to later requests [s]."""
        self._timeout_s = timeout_s
        if self._connection is not None:
            self._connection.set_timeout(max(1, round(timeout_s * 1000)))

    def read(self, place: Place, start: int = 0, size: int | None = None) -> bytes:
        """Read bytes of a variable.

        Args:
            place: Address of the variable.
            start: Offset of the first byte.
            size: Number of bytes; None for all bytes after `start`.

        Raises:
            RobotTimeout: The PLC has not answered the request in time.
            RobotConnectionError: The connection is lost, or the runtime of the PLC does not run.
            CommandRefused: The PLC refuses the request.
        """
        wanted = place.size - start if size is None else size
        with self._plain_errors(f"read {wanted} bytes"):
            data = self._opened().read(
                place.group, place.offset + start, block(wanted), return_ctypes=True
            )
            return bytes(data.bytes)

    def read_versioned(
        self, place: Place, start: int = 0, size: int | None = None
    ) -> tuple[bytes, int]:
        """Read bytes of a variable and the symbol version of the PLC, in one request.

        Raises:
            RobotError: See `read`.
        """
        from pyads import structs

        wanted = place.size - start if size is None else size
        requests = (Place(place.group, place.offset + start, wanted), VERSION)
        parts = (structs.SAdsSumRequest * len(requests))(
            *((each.group, each.offset, each.size) for each in requests)
        )
        with self._plain_errors(what := f"read {wanted} bytes"):
            answer = bytes(
                self._opened().read_write(
                    SUM_READ, len(requests), None, parts, None, return_ctypes=True
                )
            )
        for code in np.frombuffer(answer, "<u4", len(requests)).tolist():
            if code:
                raise error_of_code(code, self.where, what)
        return answer[8:-1], answer[-1]

    def write(self, place: Place, data: bytes, start: int = 0) -> None:
        """Write bytes of a variable; raise the same exceptions as `read`."""
        kind = block(len(data))
        with self._plain_errors(f"write {len(data)} bytes"):
            self._opened().write(
                place.group, place.offset + start, kind.from_buffer_copy(data), kind
            )

    def _opened(self) -> Any:
        connection = self._connection
        if connection is None:
            raise RobotConnectionError(f"{self.where} is not connected", hint="call connect()")
        return connection

    @contextmanager
    def _plain_errors(self, what: str) -> Iterator[None]:
        """Convert errors of `pyads` to exceptions of `hil`."""
        pyads = library()
        try:
            yield
            self._answered = True
        except pyads.ADSError as error:
            raise error_of(
                error, self.where, what, timeout_s=self._timeout_s, answered=self._answered
            ) from error
        except (RuntimeError, TypeError) as error:  # too few bytes, or line closed
            raise RobotConnectionError(
                f"{self.where}: {what}: {error}", hint="connect again"
            ) from error


@cache
def block(size: int) -> type[ctypes.Structure]:
    """Return a ctypes structure of `size` bytes, because `pyads` converts arrays slowly."""
    return type(
        f"Block{size}", (ctypes.Structure,), {"_fields_": [("bytes", ctypes.c_ubyte * size)]}
    )


def one(data: bytes, kind: np.dtype[Any]) -> np.void:
    """Return bytes as one structure of the dtype `kind`."""
    structure: np.void = np.frombuffer(data, kind)[0]
    return structure


NO_RUNTIME, NO_ROUTE = 6, 7
BUSY, NO_SYMBOL, OTHER_VERSION, WRONG_STATE, DEVICE_TIMED_OUT = 0x708, 0x710, 0x711, 0x712, 0x719
TIMED_OUT = (0x745, 0x274C)

DEVICE_CODES = range(0x700, 0x740)
"""ADS return codes that the PLC itself sends; all other codes concern the connection."""

LOST = "check cable and PLC, then connect again"
LOOK_UP = "look up "


def error_of(
    error: Exception, where: str, what: str, *, timeout_s: float, answered: bool
) -> HilError:
    """Return the exception of `hil` that corresponds to an error of `pyads`.

    Args:
        error: Error of `pyads`.
        where: Name of the PLC, for the message.
        what: Description of the request, for the message.
        timeout_s: Time-out of the request [s].
        answered: Whether the PLC has answered an earlier request; if True, a missing route is not
            the cause of the error.
    """
    code = getattr(error, "err_code", None)
    if code in TIMED_OUT:
        return RobotTimeout(
            f"{where} has not answered within {timeout_s:g} s: {what}",
            hint=LOST if answered else ROUTE,
        )
    if isinstance(code, int) and (code in DEVICE_CODES or code in (NO_RUNTIME, NO_ROUTE)):
        return error_of_code(code, where, what, text_of(error))
    return RobotConnectionError(
        f"{where}: the connection is lost: {what}: {text_of(error)}", hint=LOST
    )


def error_of_code(code: int, where: str, what: str, library_text: str = "") -> HilError:
    """Return the exception for an ADS return code of a PLC, or of the router before the PLC.

    Args:
        code: ADS return code, not 0.
        where: Name of the PLC, for the message.
        what: Description of the request, for the message.
        library_text: Text of `pyads` for the return code.
    """
    if code == NO_SYMBOL and what.startswith(LOOK_UP):
        return PluginError(
            f"{where} has no variable {what.removeprefix(LOOK_UP)}",
            hint="download the PLC program that docs/how-to/drive-twincat.md describes, or correct "
            "the option prefix",
        )
    if code in (NO_SYMBOL, OTHER_VERSION):
        return changed_online(where)
    if code in (BUSY, DEVICE_TIMED_OUT):
        why = "is busy" if code == BUSY else "reports an internal time-out"
        hint = "check the load of TwinCAT, then try again"
        return RobotTimeout(f"{where} {why}: {what}", hint=hint)
    if code == NO_RUNTIME:
        return RobotConnectionError(
            f"{where}: no PLC runtime answers there: {what}",
            hint="bring TwinCAT into run mode, log in, start the PLC, and check the option port",
        )
    if code == WRONG_STATE:
        return RobotConnectionError(
            f"{where}: its runtime does not answer in its present state: {what}",
            hint="bring TwinCAT into run mode and start the PLC",
        )
    if code == NO_ROUTE:
        return RobotConnectionError(f"{where}: there is no route to it: {what}", hint=ROUTE)
    return CommandRefused(
        f"{where}: {what}: {library_text or f'ADS return code {code:#x}'}",
        hint="see the PLC's log",
    )


def changed_online(where: str) -> RobotFault:
    """Return the error that reports that the PLC's variables have moved in memory."""
    return RobotFault(
        f"{where}: its program was changed online, and its variables have new addresses; the "
        "heartbeat has ended, so that the PLC's watchdog stops the arm",
        hint="connect again",
    )


def text_of(error: Any) -> str:
    """Return the text of a `pyads` error on one line."""
    return str(getattr(error, "msg", None) or error).strip().rstrip(".")
