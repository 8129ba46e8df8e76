"""Mock drives beside the driver's `CanopenAcyclic`: one thread plays bus and time, no sockets."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from hil.arms import load_arm
from hil_drivers.cia402.can_bus import CanopenAcyclic
from hil_mock_robot.cia402.dictionary import registers_of
from hil_mock_robot.cia402.node import MockNode

ARM = load_arm("lab6")
TICK_S = 0.002


class Line:
    """A bus of nodes and one master; every frame goes at once to whom it concerns.

    Attributes:
        nodes: The drives.
        master: The driver's end.
        lost: Frames of the nodes for which this says True do not arrive.
    """

    def __init__(self, n: int, eds: tuple[str, ...] = ()) -> None:
        self._lock = threading.RLock()
        self.lost: Callable[[int, bytes], bool] = lambda *_: False
        self.sent: list[tuple[int, bytes]] = []
        self.nodes = [MockNode(k + 1, registers_of(ARM, k), self._answer) for k in range(n)]
        names = ARM.joint_names[:n]
        self.master = CanopenAcyclic(self._send, range(1, n + 1), names, eds)
        for node in self.nodes:
            node.boot()

    def _send(self, can_id: int, data: bytes) -> None:
        assert isinstance(data, bytes)
        with self._lock:
            self.sent.append((can_id, data))
            for node in self.nodes:
                node.heard(can_id, data)

    def _answer(self, can_id: int, data: bytes) -> None:
        if hasattr(self, "master") and not self.lost(can_id, data):
            self.master.heard(can_id, data)

    def tick(self, device_s: float) -> None:
        with self._lock:
            for node in self.nodes:
                node.ticked(device_s)


@contextlib.contextmanager
def drives(n: int = 2, eds: tuple[str, ...] = ()) -> Iterator[Line]:
    """Drives of the first joints of lab6, fresh from power-on, whose time goes on."""
    line, over = Line(n, eds), threading.Event()

    def live() -> None:
        began = time.monotonic()
        while not over.wait(TICK_S):
            line.tick(time.monotonic() - began)

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        yield line
    finally:
        over.set()
        thread.join()
