"""The line to a PLC: its variables as bytes, by ADS, with every failure told in plain words.

`pyads` brings its own router on Linux: no TwinCAT is needed here, only a route on the PLC back to
this computer. Requests of one ADS port wait for each other, so whoever must not wait has a line of
its own; all lines to one PLC share one TCP connection. `pyads` deletes the route to the PLC when
any of them is closed: close all, then open anew.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from hil.errors import PluginError, RobotConnectionError
from hil_drivers.patience import once_listening
from hil_drivers.twincat.options import Options, is_ip
from hil_drivers.twincat.return_codes import ROUTE, error_of, text_of

REACHED_WITHIN_S = 3.0
"""How long a TCP connection may take: the library itself waits for minutes [s]."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a variable is.

    Attributes:
        group, offset: Index group and offset.
        size: In bytes.
    """

    group: int
    offset: int
    size: int


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
                constants.ADSIGRP_SYM_INFOBYNAMEEX, 0, structs.SAdsSymbolEntry, name,
                constants.PLCTYPE_STRING, return_ctypes=True,
            )  # fmt: skip
            return Place(int(entry.iGroup), int(entry.iOffs), int(entry.size))

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
                place.group, place.offset + start, _block(wanted), return_ctypes=True
            )
            return bytes(data.bytes)

    def write(self, place: Place, data: bytes, start: int = 0) -> None:
        """Change bytes of a variable; raises as `read`."""
        kind = _block(len(data))
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


def address_of(options: Options) -> str:
    """What the library connects to, once it is sure that somebody listens.

    Once, before anything is open: a PLC may let go of an older connection from this computer.
    A mock that is still starting on this computer is waited for.

    Raises:
        RobotConnectionError: Nobody does.
    """
    host, _ = options.host
    if not is_ip(host):
        return _found(options)
    return once_listening(host, lambda: _found(options))


def _found(options: Options) -> str:
    host, port = options.host
    try:
        with socket.create_connection((host, port), REACHED_WITHIN_S) as line:
            found = str(line.getpeername()[0])
    except OSError as error:
        why = error.strerror or str(error) or type(error).__name__
        raise RobotConnectionError(
            f"PLC {options.address}: nobody listens on port {port}: {why}",
            hint="is it on, and is it this address? TwinCAT's ADS port 48898 must be open in its "
            "firewall; the mock is started with: hil mock plc",
        ) from error
    return f"{found}:{port}"


def library() -> Any:
    """`pyads`.

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


@cache
def _block(size: int) -> type[ctypes.Structure]:
    """So many bytes as one value: `pyads` takes arrays apart, byte by byte."""
    return type(
        f"Block{size}", (ctypes.Structure,), {"_fields_": [("bytes", ctypes.c_ubyte * size)]}
    )


def one(data: bytes, kind: np.dtype[Any]) -> np.void:
    """The structure that bytes hold."""
    found: np.void = np.frombuffer(data, kind)[0]
    return found
