"""`hil_unix`: python-can on a bus between processes of this computer, hosted by a hub.

Ordered and lossless. One packet of the socket is one frame in SocketCAN's layout: code that has no
time for `can.Message` uses `UnixBus.socket` itself.
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
"""How long `send` waits for room unless told: a hub that runs always makes some [s]."""

_NOW = socket.MSG_DONTWAIT


class UnixBus(can.BusABC):
    """One participant of a bus between processes.

    Args:
        channel: A name such as `can0`, or the absolute path of the hub's socket.
        can_filters: See `can.BusABC.set_filters`.
        **kwargs: What other interfaces need, such as `bitrate`; the bit rate is the hub's.

    Attributes:
        socket: `SOCK_SEQPACKET`, one `hil.can.frames.FRAME` a packet; empty when the hub is gone.

    Raises:
        can.CanInitializationError: No process hosts the channel, or it is none.
    """

    def __init__(self, channel: Any = "can0", can_filters: Any = None, **kwargs: Any) -> None:
        self.channel = str(channel)
        self.channel_info = f"hil_unix channel {self.channel!r}"
        self._state = can.BusState.ACTIVE
        self._overflows = 0
        self.socket = _connected(self.channel)
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def fileno(self) -> int:
        """For `select` and `can.Notifier`."""
        return self.socket.fileno()

    @property
    def state(self) -> can.BusState:
        """`ERROR` while the hub keeps this end off the bus, as far as it has read."""
        return self._state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise NotImplementedError("the state of this bus is the hub's")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame.

        Args:
            msg: A classic one.
            timeout: Wait so long for room [s]; `SEND_PATIENCE_S` when `None`.

        Raises:
            can.CanOperationError: There was no room in time, this end is off the bus, frames that
                were sent before had to be dropped (said once), or the hub is gone.
            ValueError: It is a CAN FD frame.
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
        """Leave the bus. Idempotent."""
        super().shutdown()
        if hasattr(self, "socket"):
            self.socket.close()

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        return [{"interface": "hil_unix", "channel": name} for name in named_channels()]

    def _read(self) -> bytes | None:
        try:
            return self.socket.recv(FRAME.size, _NOW)
        except (BlockingIOError, TimeoutError):  # the latter where a time-out was set
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
            f"{self}: the hub has hung up{why}: its host has ended, or this end read too slowly"
        )


def _packed(msg: can.Message) -> bytes:
    if msg.is_fd:
        raise ValueError("a bus between processes carries classic CAN frames, no CAN FD")
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
            f"nobody hosts the CAN bus {channel} ({path}: {error.strerror})\n"
            "  → the mock drives host it: start `hil mock can` on the same channel first"
        ) from error
    return connection
