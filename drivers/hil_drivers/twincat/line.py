"""The line to a PLC: its variables as bytes, by ADS, with every failure told in plain words.

`pyads` brings its own router on Linux: no TwinCAT is needed here, only a route on the PLC back to
this computer. Requests of one ADS port wait for each other, so whoever must not wait has a line of
its own; all lines to one PLC share one TCP connection. `pyads` deletes the route to the PLC when
any of them is closed: close all, then open anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hil.core import RobotConnectionError
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.places import (
    HANDLE_BY_NAME,
    INFO_BY_NAME,
    RELEASE_HANDLE,
    SUM_READ,
    VALUE_BY_HANDLE,
    VERSION,
    Place,
    block,
)
from hil_drivers.twincat.reach import library
from hil_drivers.twincat.return_codes import ROUTE, error_of, error_of_code, text_of


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
        """For messages."""
        return f"PLC {self._options.address} (AMS {self._options.ams_net_id}:{self._options.port})"

    def open(self, address: str) -> None:
        """Connect.

        Args:
            address: As `address_of` has found it.

        Raises:
            RobotConnectionError: Nobody listens there.
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
        """Let go; idempotent."""
        connection, self._connection = self._connection, None
        if connection is not None:
            pyads = library()
            try:
                connection.close()
            except (pyads.ADSError, OSError):
                return

    def state(self) -> int:
        """ADS state of the PLC's runtime; raises as `read`."""
        with self._told("asked for its state"):
            return int(self._opened().read_state()[0])

    def device(self) -> str:
        """Name and version of the PLC's runtime; raises as `read`."""
        with self._told("asked for its name"):
            name, version = self._opened().read_device_info()
            return f"{name} {version.version}.{version.revision}.{version.build}"

    def place(self, name: str) -> Place:
        """Where a variable is.

        Args:
            name: Qualified.

        Raises:
            PluginError: The PLC has none of that name.
            RobotError: As `read`.
        """
        from pyads import constants, structs

        with self._told(f"asked for {name}"):
            entry = self._opened().read_write(
                INFO_BY_NAME, 0, structs.SAdsSymbolEntry, name,
                constants.PLCTYPE_STRING, return_ctypes=True,
            )  # fmt: skip
            return Place(int(entry.iGroup), int(entry.iOffs), int(entry.size))

    def handle(self, name: str) -> Place:
        """A variable to be written by its handle.

        A PLC whose program was changed online refuses an old handle, where it would let an old
        offset change somebody else's memory.

        Raises:
            PluginError: The PLC has none of that name.
            RobotError: As `read`.
        """
        from pyads import constants

        size = self.place(name).size
        with self._told(f"asked for {name}"):
            handle = self._opened().read_write(
                HANDLE_BY_NAME, 0, constants.PLCTYPE_UDINT, name,
                constants.PLCTYPE_STRING,
            )  # fmt: skip
        return Place(VALUE_BY_HANDLE, int(handle), size)

    def release(self, handle: Place) -> None:
        """Give a handle back; raises as `read`."""
        self.write(Place(RELEASE_HANDLE, 0, 4), handle.offset.to_bytes(4, "little"))

    def version(self) -> int:
        """Of the PLC's symbols: another one once its program was changed; raises as `read`."""
        return self.read(VERSION)[0]

    def wait_for(self, timeout_s: float) -> None:
        """From now on an answer may take so long [s]."""
        self._timeout_s = timeout_s
        if self._connection is not None:
            self._connection.set_timeout(max(1, round(timeout_s * 1000)))

    def read(self, place: Place, start: int = 0, size: int | None = None) -> bytes:
        """Bytes of a variable.

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
        with self._told(f"read {wanted} bytes"):
            data = self._opened().read(
                place.group, place.offset + start, block(wanted), return_ctypes=True
            )
            return bytes(data.bytes)

    def read_versioned(
        self, place: Place, start: int = 0, size: int | None = None
    ) -> tuple[bytes, int]:
        """Bytes of a variable and, read after them in the same request, the symbols' version.

        Raises:
            RobotError: As `read`.
        """
        from pyads import structs

        wanted = place.size - start if size is None else size
        asked = (Place(place.group, place.offset + start, wanted), VERSION)
        parts = (structs.SAdsSumRequest * len(asked))(
            *((each.group, each.offset, each.size) for each in asked)
        )
        with self._told(what := f"read {wanted} bytes"):
            told = bytes(
                self._opened().read_write(
                    SUM_READ, len(asked), None, parts, None, return_ctypes=True
                )
            )
        for code in np.frombuffer(told, "<u4", len(asked)).tolist():
            if code:
                raise error_of_code(code, self.where, what)
        return told[8:-1], told[-1]

    def write(self, place: Place, data: bytes, start: int = 0) -> None:
        """Change bytes of a variable; raises as `read`."""
        kind = block(len(data))
        with self._told(f"write {len(data)} bytes"):
            self._opened().write(
                place.group, place.offset + start, kind.from_buffer_copy(data), kind
            )

    def _opened(self) -> Any:
        connection = self._connection
        if connection is None:
            raise RobotConnectionError(f"{self.where} is not connected", hint="call connect()")
        return connection

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Errors of the library as ours."""
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
