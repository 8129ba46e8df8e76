"""What the teach pendant holds: a loaded program, a popup, a log."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hil_mock_robot.ur.contracts import Program
from hil_mock_robot.ur.mode_codes import RuntimeState

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

UNNAMED = "<unnamed>"
FOLDER = "/programs/"
LOG_LINES = 1000
STATES = {
    RuntimeState.PLAYING: "PLAYING",
    RuntimeState.RESUMING: "PLAYING",
    RuntimeState.PAUSED: "PAUSED",
    RuntimeState.PAUSING: "PAUSED",
}


class IdleProgram:
    """Stands for a program made on the pendant: it plays until it is stopped, and moves nothing.

    Args:
        name: Its file, without the extension.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def begin(self, machine: Machine) -> None:
        """See `Program`."""

    def tick(self, machine: Machine) -> bool:
        """See `Program`; it never ends by itself."""
        return True

    def end(self, machine: Machine) -> None:
        """See `Program`."""


@dataclass(slots=True)
class Pendant:
    """The state behind the dashboard, the same for every client.

    Attributes:
        machine: The controller.
        programs: File → what makes that program; other files are an `IdleProgram`.
        loaded: File of the loaded program, `""` for none.
        popup: What is shown, `""` for nothing.
        role: Of the user (CB3).
        operational: Mode that the dashboard has set last, `NONE` before.
        reports: Number of the last report.
        log: The last lines added to it.
    """

    machine: Machine
    programs: Mapping[str, Callable[[], Program]] = field(default_factory=dict)
    loaded: str = ""
    popup: str = ""
    role: str = "PROGRAMMER"
    operational: str = "NONE"
    reports: int = 0
    log: deque[str] = field(default_factory=lambda: deque(maxlen=LOG_LINES))

    @property
    def running(self) -> bool:
        """Whether a program plays."""
        return self.state == "PLAYING"

    @property
    def state(self) -> str:
        """`STOPPED`, `PLAYING` or `PAUSED`."""
        return STATES.get(self.machine.runtime, "STOPPED")

    @property
    def name(self) -> str:
        """File name of the loaded program."""
        return self.loaded.rpartition("/")[2] or UNNAMED

    def load(self, file: str) -> bool:
        """Take a program from the disk; False when there is none of that name."""
        if not file.endswith(".urp") or file == ".urp":
            return False
        self.loaded = file if file.startswith("/") else FOLDER + file
        return True

    def play(self) -> bool:
        """Start what is loaded, or go on with what is paused; False when nothing plays then."""
        machine = self.machine
        if self.state == "PAUSED":
            machine.resume()
        elif self.loaded and not self.running:
            make = self.programs.get(self.name)
            name = self.name.removesuffix(".urp")
            machine.play(make() if make else IdleProgram(name))
        return self.running

    def forget(self) -> None:
        """The controller has booted: nothing is loaded or shown."""
        self.loaded = self.popup = ""
        self.operational = "NONE"

    def show(self, text: str) -> None:
        """Show a popup."""
        self.popup = text
        self.machine.tell("popup", "Popup", text)
