"""SDO server of a mock drive, based on that of `canopen`, with the aborts of a drive."""

from __future__ import annotations

from typing import Any

from canopen.sdo import server
from canopen.sdo.constants import (
    ABORT_GENERAL_ERROR,
    ABORT_INVALID_COMMAND_SPECIFIER,
    EXPEDITED,
    NO_MORE_DATA,
    REQUEST_SEGMENT_DOWNLOAD,
    REQUEST_SEGMENT_UPLOAD,
    SDO_STRUCT,
    SIZE_SPECIFIED,
)

from hil_mock_robot.cia402.access_rules import WRONG_LENGTH, require
from hil_mock_robot.cia402.dictionary import (
    CODES,
    by_key,
)

COMMAND = 0xE0
MOST_EXPEDITED = 4


class SdoServer(server.SdoServer):
    """SDO server of a node for one client.

    Args:
        node: Node with the objects (`get_data`, `set_data`).
        node_id: Node id of the node.
    """

    def __init__(self, node: Any, node_id: int) -> None:
        super().__init__(0x600 + node_id, 0x580 + node_id, node)  # type: ignore[no-untyped-call]
        self._index = self._subindex = 0
        self._open_transfer: int | None = None

    def on_request(self, can_id: int, data: bytes, timestamp: float) -> None:
        """Handle a request frame of a client."""
        command = data[0] & COMMAND
        if command not in (REQUEST_SEGMENT_UPLOAD, REQUEST_SEGMENT_DOWNLOAD):
            # A new request or an abort cancels the open transfer.
            self._open_transfer = None
        elif command != self._open_transfer:
            self.abort(ABORT_INVALID_COMMAND_SPECIFIER)
            return
        super().on_request(can_id, data, timestamp)  # type: ignore[no-untyped-call]

    def init_upload(self, request: bytes) -> None:
        """Begin a transfer in which the client reads an object."""
        self._buffer = bytearray()
        super().init_upload(request)  # type: ignore[no-untyped-call]
        self._open_transfer = REQUEST_SEGMENT_UPLOAD if self._buffer else None

    def segmented_upload(self, command: int) -> None:
        """Send the next segment of a read transfer, which ends with the last segment."""
        super().segmented_upload(command)  # type: ignore[no-untyped-call]
        if not self._buffer:
            self._open_transfer = None

    def init_download(self, request: bytes) -> None:
        """Begin a write transfer; four bytes without a stated length fit any object."""
        command, index, sub = SDO_STRUCT.unpack_from(request)
        self._index, self._subindex = index, sub  # used in an abort message
        entry = by_key().get(index << 8 | sub)
        if command & EXPEDITED and not command & SIZE_SPECIFIED and entry and entry.type in CODES:
            command |= SIZE_SPECIFIED | (MOST_EXPEDITED - entry.packing.size) << 2
        announces = command & (EXPEDITED | SIZE_SPECIFIED) == SIZE_SPECIFIED
        if announces and entry and entry.writable and entry.type in CODES:
            announced = int.from_bytes(request[4:8], "little")
            require(announced == entry.packing.size, WRONG_LENGTH)
        super().init_download(bytes([command]) + request[1:])  # type: ignore[no-untyped-call]
        self._open_transfer = None if command & EXPEDITED else REQUEST_SEGMENT_DOWNLOAD

    def segmented_download(self, command: int, request: bytes) -> None:
        """Receive a segment of a write transfer; the last segment writes the object."""
        super().segmented_download(command, request)  # type: ignore[no-untyped-call]
        if command & NO_MORE_DATA:
            self._open_transfer = None

    def abort(self, abort_code: int = ABORT_GENERAL_ERROR) -> None:
        """End the present transfer."""
        self._open_transfer = None
        super().abort(abort_code)  # type: ignore[no-untyped-call]
