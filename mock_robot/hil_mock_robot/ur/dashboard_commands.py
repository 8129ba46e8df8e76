"""The dashboard's commands and their replies.

Source: Universal Robots, "Dashboard Server" for CB3 and e-Series: texts, first versions, and
which commands want remote control.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hil_mock_robot.ur.dashboard_reports import flight_report, save_log, support_file
from hil_mock_robot.ur.dashboard_roles import clear_operational, set_operational, set_role
from hil_mock_robot.ur.mode_codes import SafetyMode
from hil_mock_robot.ur.pendant import UNNAMED, Pendant
from hil_mock_robot.ur.series import Series

TOO_SOON = (
    "Cannot unlock protective stop until 5s after occurrence. "
    "Always inspect cause of protective stop before unlocking"
)
ALWAYS = (0, 0)


@dataclass(frozen=True, slots=True)
class Command:
    """One command.

    Attributes:
        text: What a line begins with.
        reply: Does it and says what came of it; gets the rest of the line.
        cb3, e: Software it came with; None when that series has none.
        remote: Whether an e-Series controller wants remote control for it.
    """

    text: str
    reply: Callable[[Pendant, str], str]
    cb3: tuple[int, int] | None = ALWAYS
    e: tuple[int, int] | None = ALWAYS
    remote: bool = False


def command_of(line: str, series: Series) -> tuple[Command, str] | None:
    """The command of a line and its argument; None when this software knows no such command.

    The longest text wins (`load installation` before `load`); case does not matter.
    """
    for command in COMMANDS:
        head, rest = line[: len(command.text)], line[len(command.text) :]
        said = head.lower() == command.text.lower() and rest[:1] in ("", " ")
        if said and series.at_least(command.cb3, command.e):
            return command, rest.strip()
    return None


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


def _close_popup(pendant: Pendant, _: str) -> str:
    pendant.popup = ""
    return "closing popup"


def _add_to_log(pendant: Pendant, text: str) -> str:
    pendant.log.append(text)
    pendant.machine.tell("text", text=text)
    return "Added log message"


def _is_saved(pendant: Pendant, _: str) -> str:
    return f"true {pendant.name}" if pendant.loaded else f"false {UNNAMED}"


def _loaded(pendant: Pendant, _: str) -> str:
    return f"Loaded program: {pendant.loaded}" if pendant.loaded else "No program loaded"


def _version(pendant: Pendant, _: str) -> str:
    return ".".join(map(str, pendant.machine.series.version))


def _polyscope_version(pendant: Pendant, rest: str) -> str:
    return f"URSoftware {_version(pendant, rest)} ({pendant.machine.series.date})"


def _model(pendant: Pendant, _: str) -> str:
    return pendant.machine.body.arm.name.removesuffix("e").upper()


def _lower(flag: bool) -> str:
    return "true" if flag else "false"


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
    Command("close popup", _close_popup),
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
"""Every command but `quit`, which belongs to the connection."""
