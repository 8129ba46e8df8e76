"""Mock CiA 402 drives for tests of any CANopen master: their own process, a bus between processes.

python-can is imported when a bus is asked for.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.testing.mock_process import MockProcess
from hil.testing.starting import own_folder, require_extras, running

if TYPE_CHECKING:
    import can

INTERFACE = "hil_unix"


class CanBus(MockProcess):
    """Drives that run on a bus nobody else has.

    Attributes:
        interface, channel: Of the bus, as python-can wants them.
        model: The arm they move.
    """

    interface = INTERFACE

    def __init__(
        self, channel: Path, model: str, process: subprocess.Popen[str], journal: Path
    ) -> None:
        super().__init__(process, journal)
        self.channel, self.model = str(channel), model
        self._side = str(channel.with_suffix(".side"))
        self._opened = contextlib.ExitStack()

    @property
    def config(self) -> dict[str, str]:
        """For `can.Bus(**config)` and `canopen.Network().connect(**config)`."""
        return {"interface": self.interface, "channel": self.channel}

    def bus(self, **more: Any) -> can.BusABC:
        """A further participant of the bus; it is shut down when the drives end, at the latest."""
        import can

        return self._opened.enter_context(
            can.Bus(interface=INTERFACE, channel=self.channel, **more)
        )

    def end(self) -> int:
        """See `MockProcess.end`."""
        self._opened.close()
        return super().end()

    def _line(self) -> socket.socket:
        line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            line.connect(self._side)
        except OSError:
            line.close()
            raise
        return line


@contextlib.contextmanager
def can_bus(model: str = "lab6", seed: int = 0, **options: Any) -> Iterator[CanBus]:
    """Start mock drives on a bus of their own, wait until they are there, end them.

    Args:
        model: A built-in arm.
        seed: Which individual.
        **options: Further ones of `hil mock can`, with `_` for `-`: `bitrate=1_000_000`,
            `nodes=[11, 12, 13, 14, 15, 16]`, `faults=[{"kind": "emergency", "at_s": 2}]`, …

    Raises:
        PluginError: An extra is missing, or they do not start with these options.
    """
    require_extras("the mock drives", "can", "mock")
    with own_folder() as folder:
        channel = folder / "can0.sock"
        given = {"channel": channel, "model": model, "seed": seed, **options}
        with running("can", given, folder) as (process, journal):
            drives = CanBus(channel, model, process, journal)
            try:
                yield drives
            finally:
                drives.end()
