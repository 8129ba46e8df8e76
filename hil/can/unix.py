"""Python-can interface `hil_unix` for a bus between processes, hosted by a hub.

On this bus, frames arrive in order and are never lost. One packet of the socket is one frame in the
layout of SocketCAN, so time-critical code can use `UnixBus.socket` directly instead of
`can.Message`.
"""

from __future__ import annotations

import os
import select
import socket
import time
from typing import Any

import can

from hil.can.channels import named_channels, socket_path
from hil.can.frames import (
    ERROR,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    EXTENDED,
    FRAME,
    ID_MASK,
    REMOTE,
    TX_OVERFLOW,
)
from hil.core import PluginError

SEND_PATIENCE_S = 1.0
"""Default time-out of `send` [s]; a running hub always accepts a frame within this time."""

_NOW = socket.MSG_DONTWAIT


class UnixBus(can.BusABC):
    """Connection of one participant to a bus between processes, as a python-can bus.

    Args:
        channel: Name of the channel such as `can0`, or absolute path of the hub's socket.
        can_filters: Filters for received frames, as in `can.BusABC.set_filters`.
        **kwargs: Options of other interfaces, such as `bitrate`; the hub sets the bit rate.

    Attributes:
        socket: Socket of type `SOCK_SEQPACKET`, one `hil.can.frames.FRAME` per packet; after the
            hub has closed, a read returns no bytes.

    Raises:
        can.CanInitializationError: No process hosts the channel, or the channel is invalid.
    """

    def __init__(self, channel: Any = "can0", can_filters: Any = None, **kwargs: Any) -> None:
        self.channel = str(channel)
        self.channel_info = f"hil_unix channel {self.channel!r}"
        self._state = can.BusState.ACTIVE
        self._overflows = 0
        self.socket = _connected(self.channel)
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def fileno(self) -> int:
        """Return the file descriptor of the socket, for `select` and `can.Notifier`."""
        return self.socket.fileno()

    @property
    def state(self) -> can.BusState:
        """State of the CAN controller: `ERROR` after a bus-off frame of the hub was read."""
        return self._state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise NotImplementedError("the hub determines the state of this bus")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame.

        Args:
            msg: Message with a classic CAN frame.
            timeout: Longest wait while the transmit queue is full [s]; `SEND_PATIENCE_S` if `None`.

        Raises:
            can.CanOperationError: The transmit queue was full until the time-out, this participant
                is off the bus, earlier frames were dropped (reported one time), or the hub has
                closed.
            ValueError: The message is a CAN FD frame.
        """
        self._refuse_in_trouble()
        raw = _packed(msg)
        until_s = time.monotonic() + (SEND_PATIENCE_S if timeout is None else timeout)
        while True:
            try:
                self.socket.send(raw, _NOW)
                return
            except (BlockingIOError, TimeoutError):
                if not self._wait(select.POLLOUT, until_s - time.monotonic()):
                    raise can.CanOperationError(f"{self}: transmit queue full") from None
            except OSError as error:
                raise self._gone(error) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        raw = self._read()
        if raw is None and self._wait(select.POLLIN, timeout):
            raw = self._read()
        if raw is None:
            return None, False
        if not raw:
            raise self._gone()
        message = self._unpacked(raw)
        return message, message.is_error_frame

    def shutdown(self) -> None:
        """Close the connection to the bus. Idempotent."""
        super().shutdown()
        if hasattr(self, "socket"):
            self.socket.close()

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        return [{"interface": "hil_unix", "channel": name} for name in named_channels()]

    def _read(self) -> bytes | None:
        try:
            return self.socket.recv(FRAME.size, _NOW)
        except (BlockingIOError, TimeoutError):  # TimeoutError if a time-out was set
            return None
        except OSError as error:
            raise self._gone(error) from error

    def _wait(self, event: int, timeout_s: float | None) -> bool:
        if timeout_s is not None and timeout_s <= 0:
            return False
        poll = select.poll()
        poll.register(self.socket, event)
        return bool(poll.poll(None if timeout_s is None else timeout_s * 1e3))

    def _unpacked(self, raw: bytes) -> can.Message:
        can_id, length, data = FRAME.unpack(raw)
        if can_id & ERROR:
            self._met(can_id, data)
        extended, remote = bool(can_id & EXTENDED), bool(can_id & REMOTE)
        return can.Message(
            timestamp=time.time(),
            arbitration_id=can_id & (ID_MASK if extended else 0x7FF),
            is_extended_id=extended,
            is_remote_frame=remote,
            is_error_frame=bool(can_id & ERROR),
            dlc=length,
            data=None if remote else data[:length],
            channel=self.channel,
        )

    def _met(self, can_id: int, data: bytes) -> None:
        if can_id & ERROR_BUS_OFF:
            self._state = can.BusState.ERROR
        if can_id & ERROR_RESTARTED:
            self._state = can.BusState.ACTIVE
        if can_id & ERROR_CONTROLLER and data[1] & TX_OVERFLOW:
            self._overflows += 1

    def _refuse_in_trouble(self) -> None:
        if self._state is can.BusState.ERROR:
            raise can.CanOperationError(f"{self}: this end is off the bus")
        if self._overflows:
            dropped, self._overflows = self._overflows, 0
            raise can.CanOperationError(
                f"{self}: transmit queue full, {dropped} frames were dropped"
            )

    def _gone(self, error: OSError | None = None) -> can.CanOperationError:
        why = f" ({error.strerror})" if error else ""
        return can.CanOperationError(
            f"{self}: the hub closed the connection{why}: its host has ended, or this end read "
            "too slowly"
        )


def _packed(msg: can.Message) -> bytes:
    if msg.is_fd:
        raise ValueError("a bus between processes carries classic CAN frames only, not CAN FD")
    flags = (EXTENDED if msg.is_extended_id else 0) | (REMOTE if msg.is_remote_frame else 0)
    flags |= ERROR if msg.is_error_frame else 0
    return FRAME.pack(msg.arbitration_id | flags, msg.dlc, bytes(msg.data))


def _connected(channel: str) -> socket.socket:
    try:
        path = socket_path(channel)
    except PluginError as error:
        raise can.CanInitializationError(str(error)) from error
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.connect(os.fspath(path))
    except OSError as error:
        connection.close()
        raise can.CanInitializationError(
            f"the CAN bus {channel} has no host ({path}: {error.strerror})\n"
            "  → start the mock drives on the same channel first, which host it: `hil mock can`"
        ) from error
    return connection
