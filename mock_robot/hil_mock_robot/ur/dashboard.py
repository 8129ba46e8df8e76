"""Dashboard server of the mock controller (port 29999), and the teach pendant behind it.

The dashboard server answers each line with one line. `COMMANDS` is the table of dashboard commands
and replies. `Pendant` contains the state of a teach pendant: a loaded program, popups and a log.
`PRESSES` contains the pendant buttons that the side channel can press. In contrast to dashboard
commands, buttons work in local control, and one button releases the emergency stop.

The source is Universal Robots, "Dashboard Server" for CB3 and e-Series: texts, first software
versions, and commands that need remote control. Replies about logs and reports match the
expectations of UR's client library.
"""

from __future__ import annotations

import calendar
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hil.core import CommandRefused, SpecError
from hil_mock_robot.ur.connections import Link
from hil_mock_robot.ur.machine import Event, Machine, Program
from hil_mock_robot.ur.modes import UNLOCK_AFTER_S, RuntimeState, SafetyMode
from hil_mock_robot.ur.rtde_variables import Series
from hil_mock_robot.ur.scripts import program_of

GREETING = "Connected: Universal Robots Dashboard Server"

REFUSED = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)

LONGEST_LINE = 4096
"""Maximum length of a line [bytes]; longer lines are dropped."""

MOST_PENDING = 64_000
"""Number of bytes of unread replies beyond which the client is disconnected."""


class DashboardService:
    """Dashboard server: commands of the teach pendant.

    Args:
        machine: Simulated controller.
        programs: Map from file name to the constructor of the program, for files with an action;
            None for the programs of `disk_of`.

    Attributes:
        port: TCP port of the service.
        pendant: State of the teach pendant.
    """

    port = 29999

    def __init__(
        self, machine: Machine, programs: Mapping[str, Callable[[], Program]] | None = None
    ) -> None:
        self.pendant = Pendant(machine, disk_of(machine) if programs is None else programs)
        machine.listeners.append(self._heard)

    def accept(self, link: Link) -> DashboardSession:
        """Return the session of a new client, which sends the greeting."""
        return DashboardSession(self.pendant, link)

    def _heard(self, event: Event) -> None:
        if event.kind == "booted":
            self.pendant.forget()


class DashboardSession:
    """Session of one dashboard client.

    Args:
        pendant: State of the teach pendant.
        link: Connection to the client.
    """

    lossless = False

    def __init__(self, pendant: Pendant, link: Link) -> None:
        self._pendant, self._link = pendant, link
        self._waiting = bytearray()
        self._skipping = False
        self._say(GREETING)

    def received(self, data: bytes) -> None:
        """Answer every complete line, in order; see `Session`."""
        self._waiting += data
        while not self._link.closed and (end := self._waiting.find(b"\n")) >= 0:
            line = bytes(self._waiting[:end])
            del self._waiting[: end + 1]
            if not self._skipping:
                self._answer(line)
            self._skipping = False
        if len(self._waiting) > LONGEST_LINE:
            self._waiting.clear()
            if not self._skipping:
                self._say("could not understand: a line that does not end")
            self._skipping = True

    def ticked(self) -> None:
        """Do nothing, because no data are due after a tick; see `Session`."""

    def hung_up(self) -> None:
        """See `Session`."""

    def _answer(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").strip()
        if not line:
            return
        if line.lower() == "quit":
            self._say("Disconnected")
            self._link.close()
            return
        machine = self._pendant.machine
        found = command_of(line, machine.series)
        if found is None:
            self._say(f"could not understand: {line}")
            return
        command, argument = found
        local = machine.series.is_e and not machine.modes.remote
        self._say(REFUSED if local and command.remote else command.reply(self._pendant, argument))

    def _say(self, text: str) -> None:
        if self._link.pending > MOST_PENDING:
            self._link.close()
        else:
            self._link.send(text.encode() + b"\n")


TOO_SOON = (
    "Cannot unlock protective stop until 5s after occurrence. "
    "Always inspect cause of protective stop before unlocking"
)

ALWAYS = (0, 0)
LOG_LINES = 1000

STATES = {
    RuntimeState.PLAYING: "PLAYING",
    RuntimeState.RESUMING: "PLAYING",
    RuntimeState.PAUSED: "PAUSED",
    RuntimeState.PAUSING: "PAUSED",
}

UNNAMED = "<unnamed>"
FOLDER = "/programs/"


@dataclass(slots=True)
class Pendant:
    """State of the teach pendant, common to all clients of the dashboard server.

    Attributes:
        machine: Simulated controller.
        programs: Map from file name to the constructor of the program; other files are an
            `IdleProgram`.
        loaded: Path of the loaded program; `""` for none.
        role: User role that a client has set (CB3).
        operational: Operational mode last set by the dashboard; `NONE` before the first setting.
        reports: Number of flight reports requested so far, which is also the id of the last report.
        log: Last lines that clients have added to the log.
    """

    machine: Machine
    programs: Mapping[str, Callable[[], Program]] = field(default_factory=dict)
    loaded: str = ""
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
        """Program state: `STOPPED`, `PLAYING` or `PAUSED`."""
        return STATES.get(self.machine.runtime, "STOPPED")

    @property
    def name(self) -> str:
        """File name of the loaded program."""
        return self.loaded.rpartition("/")[2] or UNNAMED

    def load(self, file: str) -> bool:
        """Load a program from the disk; return False if there is no program with this name."""
        if not file.endswith(".urp") or file == ".urp":
            return False
        self.loaded = file if file.startswith("/") else FOLDER + file
        return True

    def play(self) -> bool:
        """Start the loaded program or resume a paused program; return whether a program plays."""
        machine = self.machine
        if self.state == "PAUSED":
            machine.resume()
        elif self.loaded and not self.running:
            make = self.programs.get(self.name)
            name = self.name.removesuffix(".urp")
            machine.play(make() if make else IdleProgram(name))
        return self.running

    def forget(self) -> None:
        """Reset the pendant after the controller has restarted: no program is loaded."""
        self.loaded = ""
        self.operational = "NONE"

    def show(self, text: str) -> None:
        """Show a popup."""
        self.machine.tell("popup", "Popup", text)


@dataclass(frozen=True, slots=True)
class Command:
    """Command of the dashboard server.

    Attributes:
        text: Text with which a line of this command begins.
        reply: Function that executes the command and returns the reply; called with the rest of the
            line.
        cb3, e: First software version with this command, for CB3 and for e-Series; None if the
            series lacks the command.
        remote: Whether an e-Series controller requires remote control for the command.
    """

    text: str
    reply: Callable[[Pendant, str], str]
    cb3: tuple[int, int] | None = ALWAYS
    e: tuple[int, int] | None = ALWAYS
    remote: bool = False


def _load(pendant: Pendant, file: str) -> str:
    if pendant.running or not pendant.load(file):
        return f"{'Error while loading program' if pendant.running else 'File not found'}: {file}"
    return f"Loading program: {pendant.loaded}"


def _play(pendant: Pendant, _: str) -> str:
    return "Starting program" if pendant.play() else "Failed to execute: play"


def _stop(pendant: Pendant, _: str) -> str:
    pendant.machine.halt()
    return "Stopped"


def _pause(pendant: Pendant, _: str) -> str:
    if not pendant.running:
        return "Failed to execute: pause"
    pendant.machine.pause()
    return "Pausing program"


def _shutdown(pendant: Pendant, _: str) -> str:
    pendant.machine.halt()
    pendant.machine.modes.power_off()
    pendant.machine.tell("shutdown")
    return "Shutting down"


def _power_on(pendant: Pendant, _: str) -> str:
    pendant.machine.modes.power_on()
    return "Powering on"


def _power_off(pendant: Pendant, _: str) -> str:
    pendant.machine.modes.power_off()
    return "Powering off"


def _brake_release(pendant: Pendant, _: str) -> str:
    pendant.machine.modes.release_brakes()
    return "Brake releasing"


def _unlock(pendant: Pendant, _: str) -> str:
    modes = pendant.machine.modes
    if modes.safety is SafetyMode.PROTECTIVE_STOP and not modes.unlock():
        return TOO_SOON
    return "Protective stop releasing"


def _restart_safety(pendant: Pendant, _: str) -> str:
    pendant.machine.modes.restart_safety()
    return "Restarting safety"


def _popup(pendant: Pendant, text: str) -> str:
    pendant.show(text)
    return "showing popup"


def _add_to_log(pendant: Pendant, text: str) -> str:
    pendant.log.append(text)
    pendant.machine.tell("text", text=text)
    return "Added log message"


def save_log(_pendant: Pendant, _: str) -> str:
    """Return the reply that the log is saved; no file is written."""
    return "Log saved to disk"


REPORTS = ("CONTROLLER", "SOFTWARE", "SYSTEM")


def flight_report(pendant: Pendant, kind: str) -> str:
    """Increment the report number and return the reply; no report is generated."""
    if kind.upper() not in REPORTS:
        return f"Failed to execute: generate flight report {kind}".rstrip()
    pendant.reports += 1
    return f"Flight Report generated with id: {pendant.reports}"


def support_file(pendant: Pendant, folder: str) -> str:
    """Return the reply with the name of the file that a real controller would write."""
    if not folder:
        return "Failed to execute: generate support file"
    pendant.reports += 1
    name = f"ur_{pendant.machine.serial}_{_clock(pendant)}.zip"
    return f"Completed successfully: {folder.rstrip('/')}/{name}"


def _clock(pendant: Pendant) -> str:
    """Return the date and time of the controller.

    The clock starts at the date of the software, so that two runs produce equal file names.
    """
    began = calendar.timegm(time.strptime(pendant.machine.series.date, "%b %d %Y"))
    return time.strftime("%Y-%m-%d_%H-%M-%S", time.gmtime(began + pendant.machine.now_s))


def _loaded(pendant: Pendant, _: str) -> str:
    return f"Loaded program: {pendant.loaded}" if pendant.loaded else "No program loaded"


def _is_saved(pendant: Pendant, _: str) -> str:
    return f"true {pendant.name}" if pendant.loaded else f"false {UNNAMED}"


def _polyscope_version(pendant: Pendant, rest: str) -> str:
    return f"URSoftware {_version(pendant, rest)} ({pendant.machine.series.date})"


def _version(pendant: Pendant, _: str) -> str:
    return ".".join(map(str, pendant.machine.series.version))


def _model(pendant: Pendant, _: str) -> str:
    return pendant.machine.body.arm.name.removesuffix("e").upper()


def _lower(flag: bool) -> str:
    return "true" if flag else "false"


ROLES = ("PROGRAMMER", "OPERATOR", "NONE", "LOCKED", "RESTRICTED")


def set_role(pendant: Pendant, role: str) -> str:
    """Set the role of the user."""
    if role.upper() not in ROLES:
        return f"Failed setting user role: {role}"
    pendant.role = role.upper()
    return f"Setting user role: {role}"


def set_operational(pendant: Pendant, mode: str) -> str:
    """Set the operational mode; the dashboard then controls it."""
    if mode.upper() not in ("MANUAL", "AUTOMATIC"):
        return f"could not understand: set operational mode {mode}"
    pendant.operational = mode.upper()
    return f"Operational mode {pendant.operational} is set"


def clear_operational(pendant: Pendant, _: str) -> str:
    """Release control of the operational mode; the mode itself does not change."""
    now = pendant.operational
    return f"No longer controlling the operational mode. Current operational mode: '{now}'."


COMMANDS = (
    Command("load installation", lambda _, f: f"Loading installation: {f}", (3, 2), remote=True),
    Command("load", _load, remote=True),
    Command("play", _play, remote=True),
    Command("stop", _stop, remote=True),
    Command("pause", _pause, remote=True),
    Command("shutdown", _shutdown, remote=True),
    Command("power on", _power_on, remote=True),
    Command("power off", _power_off, remote=True),
    Command("brake release", _brake_release, remote=True),
    Command("unlock protective stop", _unlock, remote=True),
    Command("restart safety", _restart_safety, (3, 7), (5, 1), remote=True),
    Command("close safety popup", lambda _p, _: "closing safety popup", remote=True),
    Command("close popup", lambda _p, _: "closing popup"),
    Command("popup", _popup),
    Command("addToLog", _add_to_log),
    Command("saveLog", save_log),
    Command("generate flight report", flight_report, (3, 13), (5, 8)),
    Command("generate support file", support_file, (3, 13), (5, 8)),
    Command("running", lambda p, _: f"Program running: {_lower(p.running)}"),
    Command("robotmode", lambda p, _: f"Robotmode: {p.machine.modes.robot.name}"),
    Command("safetymode", lambda p, _: f"Safetymode: {p.machine.modes.safety.name}"),
    Command(
        "safetystatus",
        lambda p, _: f"Safetystatus: {p.machine.modes.safety.name}",
        None,
        (5, 4),
    ),
    Command("programState", lambda p, _: f"{p.state} {p.name}"),
    Command("get loaded program", _loaded),
    Command("isProgramSaved", _is_saved),
    Command("PolyscopeVersion", _polyscope_version),
    Command("version", _version, None),
    Command("get serial number", lambda p, _: p.machine.serial, (3, 12), (5, 6)),
    Command("get robot model", _model, (3, 12), (5, 6)),
    Command("is in remote control", lambda p, _: _lower(p.machine.modes.remote), None, (5, 6)),
    Command("setUserRole", set_role, (3, 1), None),
    Command("getUserRole", lambda p, _: p.role, (3, 1), None),
    Command("set operational mode", set_operational, None),
    Command("get operational mode", lambda p, _: p.operational, None, (5, 6)),
    Command("clear operational mode", clear_operational, None),
)
"""All commands except `quit`, which the session handles."""


def command_of(line: str, series: Series) -> tuple[Command, str] | None:
    """Return the command of a line and its argument; None if this software has no such command.

    If several commands match the line, the command with the longest text is returned (`load
    installation` before `load`); case is ignored.
    """
    for command in COMMANDS:
        head, rest = line[: len(command.text)], line[len(command.text) :]
        matches = head.lower() == command.text.lower() and rest[:1] in ("", " ")
        if matches and series.at_least(command.cb3, command.e):
            return command, rest.strip()
    return None


class IdleProgram:
    """Placeholder for a program created on the pendant: it plays until stopped and does not move.

    Args:
        name: File name without the extension.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def begin(self, machine: Machine) -> None:
        """See `Program`."""

    def tick(self, machine: Machine) -> bool:
        """Return True, because the program never ends by itself; see `Program`."""
        return True

    def end(self, machine: Machine) -> None:
        """See `Program`."""


def _cause(what: str) -> Callable[[Machine], bool]:
    return lambda machine: machine.modes.cause(what)


def _press_play(machine: Machine) -> bool:
    machine.resume()
    return machine.runtime is RuntimeState.PLAYING


def _press_pause(machine: Machine) -> bool:
    playing = machine.runtime is RuntimeState.PLAYING
    machine.pause()
    return playing


def _press_stop(machine: Machine) -> bool:
    machine.halt()
    return True


def _control(remote: bool) -> Callable[[Machine], bool]:
    def choose(machine: Machine) -> bool:
        machine.modes.remote = remote
        return True

    return choose


PRESSES: Mapping[str, Callable[[Machine], bool]] = {
    "unlock": _cause("unlock"),
    "release_emergency_stop": _cause("release emergency stop"),
    "restart_safety": _cause("restart safety"),
    "power_on": _cause("power on"),
    "brake_release": _cause("release brakes"),
    "power_off": _cause("power off"),
    "play": _press_play,
    "pause": _press_pause,
    "stop": _press_stop,
    "remote": _control(True),
    "local": _control(False),
}
"""Map from button to the function that presses the button and returns whether the button had an
effect."""


def pressed(machine: Machine, request: Mapping[str, Any]) -> dict[str, Any]:
    """Press a button; return the robot mode and safety mode directly afterwards.

    Raises:
        SpecError: The button does not exist.
        CommandRefused: The button has no effect in the present state.
    """
    what = request.get("press")
    if not isinstance(what, str) or what not in PRESSES:
        raise SpecError(
            f"pendant: unknown button {what!r}", hint=f"use one of {', '.join(PRESSES)}"
        )
    if not PRESSES[what](machine):
        robot, safety = machine.modes.robot.name, machine.modes.safety.name
        raise CommandRefused(
            f"pendant: {what} has no effect now: robot mode {robot}, safety mode {safety}, "
            f"program {machine.runtime.name}",
            hint=_way_out(machine),
        )
    modes = machine.modes
    return {"robot_mode": modes.robot.name, "safety_mode": modes.safety.name}


def _way_out(machine: Machine) -> str:
    safety = machine.modes.safety
    if safety is SafetyMode.PROTECTIVE_STOP:
        return f"press unlock {UNLOCK_AFTER_S:g} s of device time after the stop"
    if safety in (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP):
        return "press release_emergency_stop, then brake_release, which also switches the arm on"
    if safety is SafetyMode.SAFEGUARD_STOP:
        return 'end the safeguard stop first: {"do": "clear"}'
    if safety in (SafetyMode.FAULT, SafetyMode.VIOLATION):
        return "press restart_safety and, 2 s of device time later, brake_release"
    return "press brake_release if the arm is off or idle; wait a second if it boots"


CONTROL_LOOP = """
def rtde_control_loop():
  rtde_set_watchdog("input_int_register_0", 1, "pause")
  write_output_integer_register(0, 1)
  while True:
    if read_input_integer_register(0) == 1:
      x = read_input_float_register(0)
      y = read_input_float_register(1)
      z = read_input_float_register(2)
      rx = read_input_float_register(3)
      ry = read_input_float_register(4)
      rz = read_input_float_register(5)
      if x != 0 or y != 0 or z != 0 or rx != 0 or ry != 0 or rz != 0:
        movel(p[x, y, z, rx, ry, rz], a=1.2, v=0.08)
        write_output_integer_register(0, 0)
        while read_input_integer_register(0) == 1:
          sync()
        end
        write_output_integer_register(0, 1)
      end
    end
    sync()
  end
end
"""
"""Robot program for `example_control_loop.py`, which is part of UR's own RTDE client.

The program sets output integer 0 to 1 to request a pose, and to 0 when the pose is reached.
The client sets input integer 0 to 1 when a pose is in the input doubles 0 to 5; writing input
integer 0 also resets the watchdog. The moves of the program have a speed of 0.08 m/s. Source
of this protocol: RTDE_Python_Client_Library, `examples/rtde_control_loop.urp`.
"""


def disk_of(machine: Machine) -> Mapping[str, Callable[[], Program]]:
    """Return the map from file name to constructor of the program, for a machine."""
    return {"rtde_control_loop.urp": lambda: program_of(CONTROL_LOOP, machine)}
