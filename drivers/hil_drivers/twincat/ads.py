"""Connections to a PLC by ADS: its variables as bytes, and plain errors for every failure.

`listening_address` finds the PLC's ADS port by plain TCP, before anything of ADS is opened. `Line`
is one ADS port of this computer. `pyads` brings its own router on Linux: no TwinCAT is needed here,
only a route on the PLC back to this computer. Requests of one ADS port wait for each other, so
requests that must not wait have a line of their own; all lines to one PLC share one TCP connection.
`pyads` deletes the route to the PLC when any of them is closed: close all, then open anew.

ADS return codes become errors of `hil` by what is to be done about them (`error_of`): a missing
route, a runtime that does not run and a program that was changed online look alike in the library.
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
"""How long a TCP connection may take: the library itself waits for minutes [s]."""


def listening_address(options: Options) -> str:
    """Return host and port for `Line.open` if something listens there; no ADS is spoken.

    Raises:
        RobotConnectionError: Nothing listens there.
    """
    host, port = options.host
    try:
        return f"{peer_of(host, port, CONNECTED_WITHIN_S)}:{port}"
    except OSError as error:
        raise RobotConnectionError(
            f"PLC {options.address}: nobody listens on port {port}: {reason(error)}",
            hint="is it on, and is it this address? TwinCAT's ADS port 48898 must be open in its "
            "firewall; the mock is started with: hil mock plc",
        ) from error


def library() -> Any:
    """Return `pyads`.

    Raises:
        PluginError: It is not installed, or cannot be used here.
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
"""Index groups of ADS."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a variable is.

    Attributes:
        group, offset: Index group and offset; or the group of handles, and a handle.
        size: In bytes.
    """

    group: int
    offset: int
    size: int


VERSION = Place(0xF008, 0, 1)
"""Version of the PLC's symbols: another one once its program was changed online."""

RUN = 5

STATES = {2: "RESET", 3: "INIT", 4: "START", 5: "RUN", 6: "STOP", 11: "ERROR", 15: "CONFIG"}
"""ADS states of a runtime."""

ROUTE = (
    "add a route to this computer on the PLC (TwinCAT: System, Routes), and see that ams_net_id "
    "is the PLC's"
)


class Line:
    """One ADS port of this computer, connected to one of the PLC's.

    Args:
        options: Of the arm.
        timeout_s: How long an answer may take [s].
    """

    def __init__(self, options: Options, timeout_s: float) -> None:
        self._options, self._timeout_s = options, timeout_s
        self._connection: Any = None
        self._answered = False

    @property
    def where(self) -> str:
        """The PLC, for messages."""
        return f"PLC {self._options.address} (AMS {self._options.ams_net_id}:{self._options.port})"

    def open(self, address: str) -> None:
        """Connect.

        Args:
            address: As `listening_address` returns it.

        Raises:
            RobotConnectionError: Nothing listens there.
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
        """Close the connection; idempotent."""
        connection, self._connection = self._connection, None
        if connection is not None:
            pyads = library()
            try:
                connection.close()
            except (pyads.ADSError, OSError):
                return

    def state(self) -> int:
        """Read the ADS state of the PLC's runtime; raises as `read`."""
        with self._plain_errors("asked for its state"):
            return int(self._opened().read_state()[0])

    def device(self) -> str:
        """Read name and version of the PLC's runtime; raises as `read`."""
        with self._plain_errors("asked for its name"):
            name, version = self._opened().read_device_info()
            return f"{name} {version.version}.{version.revision}.{version.build}"

    def place(self, name: str) -> Place:
        """Ask where a variable is.

        Args:
            name: Qualified.

        Raises:
            PluginError: The PLC has none of that name.
            RobotError: As `read`.
        """
        from pyads import constants, structs

        with self._plain_errors(f"asked for {name}"):
            entry = self._opened().read_write(
                INFO_BY_NAME, 0, structs.SAdsSymbolEntry, name,
                constants.PLCTYPE_STRING, return_ctypes=True,
            )  # fmt: skip
            return Place(int(entry.iGroup), int(entry.iOffs), int(entry.size))

    def handle(self, name: str) -> Place:
        """Ask for a handle by which a variable is written.

        A PLC whose program was changed online refuses an old handle, where it would let an old
        offset change other memory.

        Raises:
            PluginError: The PLC has none of that name.
            RobotError: As `read`.
        """
        from pyads import constants

        size = self.place(name).size
        with self._plain_errors(f"asked for {name}"):
            handle = self._opened().read_write(
                HANDLE_BY_NAME, 0, constants.PLCTYPE_UDINT, name,
                constants.PLCTYPE_STRING,
            )  # fmt: skip
        return Place(VALUE_BY_HANDLE, int(handle), size)

    def release(self, handle: Place) -> None:
        """Give a handle back; raises as `read`."""
        self.write(Place(RELEASE_HANDLE, 0, 4), handle.offset.to_bytes(4, "little"))

    def version(self) -> int:
        """Read the version of the PLC's symbols, which changes with its program.

        Raises:
            RobotError: As `read`.
        """
        return self.read(VERSION)[0]

    def wait_for(self, timeout_s: float) -> None:
        """Set how long answers may take from now on [s]."""
        self._timeout_s = timeout_s
        if self._connection is not None:
            self._connection.set_timeout(max(1, round(timeout_s * 1000)))

    def read(self, place: Place, start: int = 0, size: int | None = None) -> bytes:
        """Read bytes of a variable.

        Args:
            place: Of the variable.
            start: First byte.
            size: How many; all when None.

        Raises:
            RobotTimeout: It has not answered in time.
            RobotConnectionError: The connection is gone, or its runtime is.
            CommandRefused: It does not give them.
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
        """Read bytes of a variable and, after them in the same request, the symbols' version.

        Raises:
            RobotError: As `read`.
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
        """Write bytes of a variable; raises as `read`."""
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
        """Raise errors of the library as errors of `hil`."""
        pyads = library()
        try:
            yield
            self._answered = True
        except pyads.ADSError as error:
            raise error_of(
                error, self.where, what, timeout_s=self._timeout_s, answered=self._answered
            ) from error
        except (RuntimeError, TypeError) as error:  # too few bytes; closed by another thread
            raise RobotConnectionError(
                f"{self.where}: {what}: {error}", hint="connect again"
            ) from error


@cache
def block(size: int) -> type[ctypes.Structure]:
    """Return a ctypes structure of so many bytes: `pyads` takes arrays apart, byte by byte."""
    return type(
        f"Block{size}", (ctypes.Structure,), {"_fields_": [("bytes", ctypes.c_ubyte * size)]}
    )


def one(data: bytes, kind: np.dtype[Any]) -> np.void:
    """Return bytes as one structure."""
    structure: np.void = np.frombuffer(data, kind)[0]
    return structure


NO_RUNTIME, NO_ROUTE = 6, 7
BUSY, NO_SYMBOL, OTHER_VERSION, WRONG_STATE, DEVICE_TIMED_OUT = 0x708, 0x710, 0x711, 0x712, 0x719
TIMED_OUT = (0x745, 0x274C)

DEVICE_CODES = range(0x700, 0x740)
"""Answers of the PLC itself; all others come from the way to it."""

LOST = "see to cable and PLC, then connect again"
ASKED = "asked for "


def error_of(
    error: Exception, where: str, what: str, *, timeout_s: float, answered: bool
) -> HilError:
    """Return the error of `hil` for an error of `pyads`.

    Args:
        error: Of `pyads`.
        where: Which PLC.
        what: The request, in words.
        timeout_s: How long was waited [s].
        answered: Whether this PLC has ever answered: a missing route is no reason then.
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
    """Return the error for a return code of a PLC, or of the router before it.

    Args:
        code: Not 0.
        where: Which PLC.
        what: The request, in words.
        library_text: The library's text for the code.
    """
    if code == NO_SYMBOL and what.startswith(ASKED):
        return PluginError(
            f"{where} has no variable {what.removeprefix(ASKED)}",
            hint="download the PLC program that docs/how-to/drive-twincat.md describes, or mend "
            "the option prefix",
        )
    if code in (NO_SYMBOL, OTHER_VERSION):
        return changed_online(where)
    if code in (BUSY, DEVICE_TIMED_OUT):
        why = "is busy" if code == BUSY else "has timed out in itself"
        return RobotTimeout(f"{where} {why}: {what}", hint="see to TwinCAT's load, then try again")
    if code == NO_RUNTIME:
        return RobotConnectionError(
            f"{where}: no PLC runtime answers there: {what}",
            hint="bring TwinCAT into run mode, log in, start the PLC; is port its runtime's?",
        )
    if code == WRONG_STATE:
        return RobotConnectionError(
            f"{where}: its runtime is in a state in which it answers nothing: {what}",
            hint="bring TwinCAT into run mode and start the PLC",
        )
    if code == NO_ROUTE:
        return RobotConnectionError(f"{where}: there is no route to it: {what}", hint=ROUTE)
    return CommandRefused(
        f"{where}: {what}: {library_text or f'ADS return code {code:#x}'}",
        hint="see the PLC's log",
    )


def changed_online(where: str) -> RobotFault:
    """Return the error for a program whose variables have moved in memory."""
    return RobotFault(
        f"{where}: its program was changed online: variables lie elsewhere now; the heartbeat has "
        "ended, so that the PLC's watchdog brings the arm to rest",
        hint="connect again",
    )


def text_of(error: Any) -> str:
    """Return the text of an error of the library, on one line."""
    return str(getattr(error, "msg", None) or error).strip().rstrip(".")
