"""The dashboard of the mock UR controller, line by line."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_mock_robot.ur.dashboard import COMMANDS, LONGEST_LINE, DashboardService
from hil_mock_robot.ur.modes import RobotMode, RuntimeState
from tests.support.fuzzing import examples
from tests.support.paths import DOCS
from tests.support.ur_control_parts import HOME
from tests.support.ur_machine import SERIAL, Wire, machine_of, movej, pass_time

REFUSAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)
TOO_SOON = (
    "Cannot unlock protective stop until 5s after occurrence. "
    "Always inspect cause of protective stop before unlocking"
)


class Desk:
    """A dashboard and one client."""

    def __init__(self, arm="ur5", powered=True):
        self.machine = machine_of(arm, powered)
        self.service = DashboardService(self.machine)
        self.wire = Wire()
        self.session = self.service.accept(self.wire)
        self.greeting = self.wire.take().decode()
        self.events = []
        self.machine.listeners.append(self.events.append)

    def ask(self, line):
        self.session.received(line.encode() + b"\n")
        reply = self.wire.take().decode()
        assert reply.endswith("\n")
        assert reply.count("\n") == 1
        return reply[:-1]


@pytest.fixture
def cb3():
    return Desk()


@pytest.fixture
def e_series():
    return Desk("ur5e")


def test_a_client_is_greeted(cb3):
    assert cb3.greeting == "Connected: Universal Robots Dashboard Server\n"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arm", "line", "reply"),
    [
        ("ur5", "PolyscopeVersion", "URSoftware 3.15.8.106339 (Apr 17 2022)"),
        ("ur5e", "PolyscopeVersion", "URSoftware 5.12.2.1101534 (Dec 02 2022)"),
        ("ur5e", "version", "5.12.2.1101534"),
        ("ur5", "get serial number", SERIAL),
        ("ur5e", "get serial number", SERIAL),
        ("ur5", "get robot model", "UR5"),
        ("ur5e", "get robot model", "UR5"),
        ("ur5e", "is in remote control", "true"),
        ("ur5", "robotmode", "Robotmode: RUNNING"),
        ("ur5", "safetymode", "Safetymode: NORMAL"),
        ("ur5e", "safetystatus", "Safetystatus: NORMAL"),
        ("ur5", "running", "Program running: false"),
        ("ur5", "programState", "STOPPED <unnamed>"),
        ("ur5", "get loaded program", "No program loaded"),
        ("ur5", "isProgramSaved", "false <unnamed>"),
        ("ur5", "play", "Failed to execute: play"),
        ("ur5", "pause", "Failed to execute: pause"),
        ("ur5", "stop", "Stopped"),
        ("ur5", "close popup", "closing popup"),
        ("ur5", "close safety popup", "closing safety popup"),
        ("ur5", "load installation default.installation", None),
        ("ur5", "setUserRole operator", "Setting user role: operator"),
        ("ur5", "setUserRole king", "Failed setting user role: king"),
        ("ur5e", "get operational mode", "NONE"),
        ("ur5e", "set operational mode manual", "Operational mode MANUAL is set"),
        ("ur5", "saveLog", "Log saved to disk"),
        ("ur5e", "saveLog", "Log saved to disk"),
        ("ur5", "generate flight report controller", "Flight Report generated with id: 1"),
        ("ur5e", "generate flight report System", "Flight Report generated with id: 1"),
        ("ur5", "generate flight report", "Failed to execute: generate flight report"),
        (
            "ur5e",
            "generate support file /programs/",
            f"Completed successfully: /programs/ur_{SERIAL}_2022-12-02_00-00-00.zip",
        ),
        ("ur5", "ROBOTMODE", "Robotmode: RUNNING"),
        ("ur5", "  robotmode \r", "Robotmode: RUNNING"),
    ],
)
def test_a_line_gets_its_reply(arm, line, reply):
    expected = reply or "Loading installation: default.installation"
    assert Desk(arm).ask(line) == expected


@pytest.mark.parametrize(
    ("arm", "line"),
    [
        ("ur5", "is in remote control"),
        ("ur5", "safetystatus"),
        ("ur5", "version"),
        ("ur5e", "setUserRole operator"),
        ("ur5", "make coffee"),
        ("ur5", "playback"),
        ("ur5", "loadX.urp"),
    ],
)
def test_what_this_software_does_not_know_is_said_so(arm, line):
    assert Desk(arm).ask(line) == f"could not understand: {line}"


def test_a_line_may_come_in_pieces_and_several_at_once(cb3):
    for piece in (b"robot", b"mo", b"de\nrunn"):
        cb3.session.received(piece)
    assert cb3.wire.take() == b"Robotmode: RUNNING\n"
    cb3.session.received(b"ing\nsafetymode\n")
    assert cb3.wire.take() == b"Program running: false\nSafetymode: NORMAL\n"


def test_a_line_without_end_is_not_kept(cb3):
    for _ in range(100):
        cb3.session.received(b"x" * LONGEST_LINE)
    assert cb3.wire.take().count(b"\n") == 1
    assert cb3.ask("the end of it\nrobotmode") == "Robotmode: RUNNING"


def test_bytes_that_are_no_text_get_a_reply(cb3):
    cb3.session.received(b"\xff\xfe\x00\n")
    assert cb3.wire.take().startswith(b"could not understand: ")


def test_an_empty_line_shifts_nothing(cb3):
    cb3.session.received(b"\n\r\n")
    assert cb3.wire.take() == b""


def test_quit_hangs_up(cb3):
    cb3.session.received(b"quit\nrobotmode\n")
    assert cb3.wire.take() == b"Disconnected\n"
    assert cb3.wire.closed


def test_a_client_that_never_reads_is_hung_up_on(cb3):
    cb3.wire.pending = 1_000_000
    cb3.session.received(b"robotmode\n")
    assert cb3.wire.closed


def test_shutdown_switches_the_arm_off(cb3):
    assert cb3.ask("shutdown") == "Shutting down"
    assert cb3.machine.modes.robot is RobotMode.POWER_OFF
    assert [event.kind for event in cb3.events] == ["shutdown"]


def test_from_off_to_running_and_off_again():
    desk = Desk(powered=False)
    assert desk.ask("robotmode") == "Robotmode: POWER_OFF"
    assert desk.ask("power on") == "Powering on"
    assert desk.ask("robotmode") == "Robotmode: BOOTING"
    pass_time(desk.machine, 2)
    assert desk.ask("robotmode") == "Robotmode: IDLE"
    assert desk.machine.body.braked
    assert desk.ask("brake release") == "Brake releasing"
    pass_time(desk.machine, 1)
    assert desk.ask("robotmode") == "Robotmode: RUNNING"
    assert not desk.machine.body.braked
    assert desk.ask("power off") == "Powering off"
    pass_time(desk.machine, 0.1)
    assert desk.ask("robotmode") == "Robotmode: POWER_OFF"
    assert desk.machine.body.braked


def test_a_protective_stop_is_unlocked_after_five_seconds_of_device_time(e_series):
    e_series.machine.protective_stop(4)
    assert e_series.ask("safetymode") == "Safetymode: PROTECTIVE_STOP"
    assert e_series.ask("safetystatus") == "Safetystatus: PROTECTIVE_STOP"
    assert e_series.ask("unlock protective stop") == TOO_SOON
    pass_time(e_series.machine, 5.1)
    assert e_series.ask("unlock protective stop") == "Protective stop releasing"
    assert e_series.ask("safetymode") == "Safetymode: NORMAL"


def test_an_emergency_stop_is_not_unlocked_by_the_dashboard(cb3):
    cb3.machine.emergency_stop()
    cb3.ask("unlock protective stop")
    cb3.ask("restart safety")
    assert cb3.ask("safetymode") == "Safetymode: ROBOT_EMERGENCY_STOP"


def test_a_safety_fault_is_restarted(cb3):
    cb3.machine.fault(191)
    assert cb3.ask("safetymode") == "Safetymode: FAULT"
    assert cb3.ask("restart safety") == "Restarting safety"
    pass_time(cb3.machine, 3)
    assert cb3.ask("safetymode") == "Safetymode: NORMAL"
    assert cb3.ask("robotmode") == "Robotmode: POWER_OFF"


def test_a_loaded_program_plays_pauses_goes_on_and_stops(cb3):
    assert cb3.ask("load pick.urp") == "Loading program: /programs/pick.urp"
    assert cb3.ask("get loaded program") == "Loaded program: /programs/pick.urp"
    assert cb3.ask("isProgramSaved") == "true pick.urp"
    assert cb3.ask("programState") == "STOPPED pick.urp"
    assert cb3.ask("play") == "Starting program"
    pass_time(cb3.machine, 0.1)
    assert cb3.ask("running") == "Program running: true"
    assert cb3.ask("programState") == "PLAYING pick.urp"
    assert cb3.ask("pause") == "Pausing program"
    assert cb3.ask("programState") == "PAUSED pick.urp"
    assert cb3.ask("running") == "Program running: false"
    assert cb3.ask("play") == "Starting program"
    assert cb3.machine.runtime is RuntimeState.PLAYING
    assert cb3.ask("stop") == "Stopped"
    assert cb3.ask("programState") == "STOPPED pick.urp"
    kinds = [(event.kind, event.name) for event in cb3.events]
    assert kinds == [("program_started", "pick"), ("program_stopped", "pick")]


def test_a_program_is_loaded_by_its_whole_path_too(cb3):
    assert cb3.ask("load /ursim/a.urp") == "Loading program: /ursim/a.urp"
    assert cb3.ask("programState") == "STOPPED a.urp"


@pytest.mark.parametrize("name", ["pick", "pick.txt", ".urp"])
def test_what_is_no_program_is_not_found(cb3, name):
    assert cb3.ask(f"load {name}") == f"File not found: {name}"
    assert cb3.ask("get loaded program") == "No program loaded"


def test_nothing_is_loaded_over_a_program_that_plays(cb3):
    cb3.ask("load a.urp")
    cb3.ask("play")
    assert cb3.ask("load b.urp") == "Error while loading program: b.urp"
    assert cb3.ask("programState") == "PLAYING a.urp"


@pytest.mark.parametrize("stop", ["off", "protective stop", "emergency stop"])
def test_nothing_plays_while_the_arm_cannot_run(cb3, stop):
    cb3.ask("load a.urp")
    {
        "off": cb3.machine.modes.power_off,
        "protective stop": lambda: cb3.machine.protective_stop(4),
        "emergency stop": cb3.machine.emergency_stop,
    }[stop]()
    assert cb3.ask("play") == "Failed to execute: play"
    assert cb3.ask("running") == "Program running: false"


def test_a_program_paused_by_a_protective_stop_goes_on_after_unlocking(cb3):
    cb3.ask("load a.urp")
    cb3.ask("play")
    cb3.machine.protective_stop(4)
    assert cb3.ask("programState") == "PAUSED a.urp"
    assert cb3.ask("play") == "Failed to execute: play"
    pass_time(cb3.machine, 5.1)
    cb3.ask("unlock protective stop")
    pass_time(cb3.machine, 0.1)
    assert cb3.ask("play") == "Starting program"


def test_programs_may_be_given_for_files():
    machine, begun = machine_of(), []

    class Given:
        name = "given"

        def begin(self, machine):
            begun.append(self.name)

        def tick(self, machine):
            return False

        def end(self, machine):
            pass

    service = DashboardService(machine, {"mine.urp": Given})
    session = service.accept(Wire())
    session.received(b"load mine.urp\nplay\n")
    assert begun == ["given"]
    pass_time(machine, 0.1)
    assert service.pendant.state == "STOPPED"


def test_the_program_of_urs_control_loop_example_moves_to_what_it_is_sent(cb3):
    """The client's side is that of `example_control_loop.py` of UR's own RTDE client."""
    machine = cb3.machine
    machine.move(movej(HOME, 2.0, 10.0, machine.tick_s))
    pass_time(machine, 3.0)

    def kick(word, until, seconds=20.0):
        for _ in range(round(seconds / machine.tick_s)):
            machine.write("input_int_register_0", word)
            machine.tick()
            if machine.outputs["output_int_register_0"] == until:
                return True
        return False

    cb3.ask("load rtde_control_loop.urp")
    assert cb3.ask("play") == "Starting program"
    assert kick(0, 1)
    below = np.array([0, 0, -0.05, 0, 0, 0])
    target = machine.outputs["target_TCP_pose"] + below
    for number, value in enumerate(target):
        machine.write(f"input_double_register_{number}", value)
    assert kick(1, 0)
    assert machine.outputs["target_TCP_pose"] == pytest.approx(target.tolist(), abs=1e-6)
    assert kick(0, 1)
    pass_time(machine, 0.9)
    assert cb3.ask("running") == "Program running: true"
    pass_time(machine, 0.2)
    assert cb3.ask("programState") == "PAUSED rtde_control_loop.urp", "its watchdog bites after 1 s"


def test_what_one_client_loads_the_other_plays(cb3):
    other = Wire()
    session = cb3.service.accept(other)
    cb3.ask("load a.urp")
    other.take()
    session.received(b"play\n")
    assert other.take() == b"Starting program\n"
    assert cb3.ask("running") == "Program running: true"


@pytest.mark.parametrize(
    "line",
    [
        "load a.urp",
        "play",
        "stop",
        "pause",
        "power on",
        "power off",
        "brake release",
        "unlock protective stop",
        "restart safety",
        "shutdown",
    ],
)
def test_local_control_refuses_what_moves_or_powers(e_series, line):
    e_series.machine.modes.remote = False
    assert e_series.ask(line) == REFUSAL
    assert e_series.machine.modes.robot is RobotMode.RUNNING
    assert e_series.ask("get loaded program") == "No program loaded"


@pytest.mark.parametrize(
    "line", ["robotmode", "running", "is in remote control", "popup hello", "saveLog"]
)
def test_local_control_answers_questions(e_series, line):
    e_series.machine.modes.remote = False
    assert e_series.ask(line) != REFUSAL


def test_cb3_knows_no_local_control(cb3):
    cb3.machine.modes.remote = False
    assert cb3.ask("power off") == "Powering off"
    assert cb3.machine.modes.robot is RobotMode.POWER_OFF


def test_popups_and_log_lines_are_told(cb3):
    assert cb3.ask("popup Mind the arm") == "showing popup"
    assert cb3.ask("addToLog load 3 is on") == "Added log message"
    assert [(event.kind, event.text) for event in cb3.events] == [
        ("popup", "Mind the arm"),
        ("text", "load 3 is on"),
    ]


@pytest.mark.parametrize("mode", ["MANUAL", "AUTOMATIC"])
def test_giving_back_the_operational_mode_satisfies_what_clients_match(e_series, mode):
    e_series.ask(f"set operational mode {mode.lower()}")
    reply = e_series.ask("clear operational mode")
    # UR's client library, older and newer, and the ROS driver; each matches the whole reply.
    for pattern in (
        r"(?:No longer controlling the operational mode. ).*",
        r"(?:No longer controlling the operational mode.).*",
        r"No longer controlling the operational mode\. Current operational mode: "
        r"'(MANUAL|AUTOMATIC)'\.",
    ):
        assert re.fullmatch(pattern, reply)
    assert e_series.ask("get operational mode") == mode


@pytest.mark.thorough
def test_the_dashboard_example_of_urs_client_library(e_series):
    """What it says and what it waits for, in its order; read in its source, not run."""
    dialogue = [
        ("PolyscopeVersion", "URSoftware .*"),
        ("power off", "Powering off"),
        ("robotmode", "Robotmode: POWER_OFF"),
        ("close safety popup", "closing safety popup"),
        ("power on", "Powering on"),
        ("robotmode", "Robotmode: (IDLE|RUNNING)"),
        ("brake release", "Brake releasing"),
        ("robotmode", "Robotmode: RUNNING"),
        ("load wait_program.urp", "(?:Loading program: ).*(?:wait_program.urp).*"),
        ("programState", "STOPPED wait_program.urp"),
        ("play", "Starting program"),
        ("programState", "(?:PLAYING ).*"),
        ("pause", "Pausing program"),
        ("programState", "(?:PAUSED ).*"),
        ("play", "Starting program"),
        ("programState", "(?:PLAYING ).*"),
        ("stop", "Stopped"),
        ("programState", "(?:STOPPED ).*"),
        ("power off", "Powering off"),
        ("robotmode", "Robotmode: POWER_OFF"),
        ("saveLog", "Log saved to disk"),
        ("programState", "STOPPED wait_program.urp"),
        ("power off", "Powering off"),
    ]
    for line, expected in dialogue:
        assert re.fullmatch(expected, e_series.ask(line)), line
        pass_time(e_series.machine, 2.0 if line in ("power on", "brake release") else 0.1)


def test_a_support_file_needs_a_folder(cb3):
    assert cb3.ask("generate support file") == "Failed to execute: generate support file"


def test_a_role_is_kept(cb3):
    cb3.ask("setUserRole locked")
    assert cb3.ask("getUserRole") == "LOCKED"


def test_a_controller_that_has_booted_has_nothing_loaded(cb3):
    cb3.ask("load a.urp")
    cb3.machine.tell("booted")
    assert cb3.ask("get loaded program") == "No program loaded"


PAGE = DOCS / "reference" / "mock-ur-dashboard.md"
LINES = st.one_of(
    st.binary(max_size=60),
    st.builds(
        lambda command, rest: f"{command.text} {rest}".encode(),
        st.sampled_from(COMMANDS),
        st.text(max_size=20),
    ),
)


@examples(40)
@given(lines=st.lists(LINES, max_size=8), cuts=st.lists(st.integers(1, 200), max_size=5))
def test_any_line_gets_one_reply_however_it_is_cut(lines, cuts):
    lines = [line.replace(b"\n", b" ") for line in lines]
    lines = [line for line in lines if line.decode("utf-8", "replace").strip().lower() != "quit"]
    desk = DESKS[len(lines) % 2]
    data = b"".join(line + b"\n" for line in lines)
    at = 0
    for cut in [*cuts, len(data)]:
        desk.session.received(data[at : at + cut])
        at += cut
    desk.session.received(data[at:])
    said = [line for line in lines if line.decode("utf-8", "replace").strip()]
    assert desk.wire.take().count(b"\n") == len(said)
    assert desk.ask("robotmode").startswith("Robotmode: ")


DESKS = (Desk(), Desk("ur5e"))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.text)
def test_every_command_is_documented(command):
    assert f"`{command.text}" in PAGE.read_text(encoding="utf-8")
