"""What all mock servers share: command line, announcement, refusals, side channel, journal, end.

One table of the servers; what only one of them has is in the tests of that mock.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.cli.app import app as hil
from hil.core.errors import CommandRefused, PluginError, RobotConnectionError, SpecError
from hil_mock_robot.cia402 import mock as can_mock
from hil_mock_robot.server.options import loopback_of
from hil_mock_robot.server.side_channel import Tell
from hil_mock_robot.twincat import mock as plc_mock
from hil_mock_robot.ur import mock as ur_mock
from hil_mock_robot.ur.connections import listen
from tests.support.mock_servers import (
    SIDE_PORT,
    MockServer,
    command_of,
    loopback,
    mock_can,
    mock_plc,
    mock_ur,
)
from tests.support.waiting import until

Place = str | tuple[str, int]


@dataclass(frozen=True)
class Server:
    """A row of the table.

    Attributes:
        module: Has `main` and `TELL`.
        run: Runs one with its files in a folder, in a place of its own or, if given, there.
        place_of: Where it listens: a word that a second one may be given.
        place_option: By which it is given.
        side_of: Place of its side channel.
        here: Options of its command line that name a mock that runs.
        model: Arm by default.
        options: Some of its help.
        lasting: A kind of fault that lasts until it is cleared.
        journal_has_faults: Whether its journal names faults on request.
    """

    module: Any
    run: Callable[..., AbstractContextManager[Any]]
    place_option: str
    place_of: Callable[[Any], str]
    side_of: Callable[[Any], Place]
    here: Callable[[Any], list[str]]
    model: str
    options: tuple[str, ...]
    lasting: str
    journal_has_faults: bool = True

    @property
    def tell(self) -> Tell:
        return self.module.TELL


@contextlib.contextmanager
def run_ur(folder: Path, *arguments: str, place: str = "", **more: Any) -> Iterator[MockServer]:
    with mock_ur(*arguments, journal=folder / "journal", address=place or None, **more) as mock:
        yield mock


@contextlib.contextmanager
def run_can(folder: Path, *arguments: str, place: str = "", **more: Any) -> Iterator[MockServer]:
    channel = place or folder / "can.sock"
    with mock_can(*arguments, journal=folder / "journal", channel=channel, **more) as mock:
        yield mock


@contextlib.contextmanager
def run_plc(folder: Path, *arguments: str, place: str = "", **more: Any) -> Iterator[MockServer]:
    with mock_plc(folder, *arguments, address=place or None, **more) as mock:
        yield mock


SERVERS = {
    "ur": Server(
        ur_mock,
        run_ur,
        "--address",
        lambda mock: mock.address,
        lambda mock: (mock.address, SIDE_PORT),
        lambda mock: ["--address", mock.address],
        "ur5",
        ("--speed", "--side-port", "--local", "--serial"),
        "inputs_owned",
    ),
    "can": Server(
        can_mock,
        run_can,
        "--channel",
        lambda mock: mock.channel,
        lambda mock: mock.side_path,
        lambda mock: ["--channel", mock.channel],
        "lab6",
        ("--interface", "--bitrate", "--nodes", "--eds"),
        "bit12_low",
    ),
    "plc": Server(
        plc_mock,
        run_plc,
        "--address",
        lambda mock: mock.address,
        lambda mock: mock.side_path,
        lambda mock: ["--address", mock.address, "--side", mock.side_path],
        "lab6",
        ("--speed", "--effort", "--without", "--side"),
        "emergency_stop",
        journal_has_faults=False,
    ),
}


@pytest.fixture(scope="module", params=SERVERS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def server(name: str) -> Server:
    return SERVERS[name]


@pytest.fixture(scope="module")
def running(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Started by its command line and ended by Ctrl-C, as an operator does."""
    with server.run(tmp_path_factory.mktemp("mock"), by_command=True) as mock:
        yield mock
        assert mock.end(signal.SIGINT) == 0
    assert mock.journal()[-1]["event"] == "closed"


# The command line


def test_help_lists_options_with_their_defaults(
    name: str, server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    for prog, said in (("", f"python -m hil_mock_robot {name}"), (f"hil mock {name}",) * 2):
        with pytest.raises(SystemExit) as ended:
            server.module.main(["--help"], prog=prog)
        assert ended.value.code == 0
        shown = " ".join(capsys.readouterr().out.split())
        assert shown.startswith(f"usage: {said} ")
    shared = ("--model", "--seed", "--profile", "--start-q-deg", "--mounted-kg", "--faults", "send")
    for option in (server.place_option, *shared, "--journal", "--ground-truth", *server.options):
        assert option in shown
    assert f"(default: {server.model})" in shown
    assert "(default: 0)" in shown or "(default: 1)" in shown
    assert "None" not in shown
    assert "False" not in shown


@pytest.mark.thorough
@pytest.mark.parametrize("asked", [["ur", "--help"], ["--help"], ["-h"], ["embedded", "--help"]])
def test_hil_mock_has_the_help_of_its_mocks_and_its_own(asked: list[str]) -> None:
    command = [sys.executable, "-m", "hil", "mock", *asked]
    environment = {**os.environ, "COLUMNS": "60"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().startswith("usage: hil mock ur " if asked[0] == "ur" else "Usage: ")
    assert "hil mock" in done.stdout


def test_the_truth_is_that_of_its_usual_arm(name: str, server: Server, tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    done = CliRunner().invoke(hil, ["mock", name, "--ground-truth", str(path), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.output)["model"] == server.model
    assert json.loads(path.read_text())["arm"] == server.model


PLAN = {
    "a kind that is not known": "- {kind: quake, at_s: 1}",
    "a moment that is missing": "- {kind: KIND}",
    "a text that is no list": "quake",
}
REFUSED: dict[str, tuple[str, list[str], int, str]] = {
    "address on a network": ("ur plc", ["--address", "192.0.2.1"], 2, "not a loopback address"),
    "address of all networks": ("ur plc", ["--address", "0.0.0.0"], 2, "not a loopback address"),
    "speed in words": ("ur plc", ["--speed", "fast"], 2, "'fast' is not a valid speed"),
    "speed of zero": ("ur plc", ["--speed", "0"], 2, "is not a valid speed"),
    "speed of another mock": ("plc", ["--speed", "lock-step"], 2, "is for the UR mock"),
    "serial number in letters": ("ur", ["--serial", "abc"], 2, "digits"),
    "interface that is not there": ("can", ["--interface", "nonsense"], 2, "nonsense"),
    "two nodes for six joints": ("can", ["--nodes", "1", "2"], 2, "--nodes names 2 drives"),
    "pose of two joints": ("ur can plc", ["--start-q-deg", "1", "2"], 2, "is not a pose of the"),
    "load below zero": ("ur can plc", ["--mounted-kg", "-1", "0", "0", "0"], 2, "--mounted-kg"),
    "faults nowhere": ("ur can plc", ["--faults", "FOLDER/nowhere.yaml"], 2, "nowhere.yaml"),
    **{
        f"faults with {what}": ("ur can plc", ["--faults", f"FOLDER/{number}.yaml"], 2, ".yaml")
        for number, what in enumerate(PLAN)
    },
    "journal nowhere": ("ur can plc", ["--journal", "FOLDER/nowhere/j"], 4, "write the journal"),
    "truth nowhere": ("ur can plc", ["--ground-truth", "FOLDER/nowhere/t"], 7, "cannot write"),
}
"""What cannot be: mocks, options, exit code, some of the message."""


@pytest.mark.parametrize(
    ("name", "arguments", "code", "said"),
    [
        pytest.param(each, *row[1:], id=f"{each}: {what}")
        for what, row in REFUSED.items()
        for each in row[0].split()
    ],
)
def test_an_option_that_cannot_be_is_refused_with_a_way_out(
    name: str,
    arguments: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    server = SERVERS[name]
    for number, plan in enumerate(PLAN.values()):
        (tmp_path / f"{number}.yaml").write_text(plan.replace("KIND", server.lasting))
    place = str(tmp_path / "can.sock") if name == "can" else loopback()
    given = [each.replace("FOLDER", str(tmp_path)) for each in arguments]
    assert server.module.main([server.place_option, place, *given]) == code
    written = capsys.readouterr()
    assert "ready" not in written.out
    assert said in written.err
    assert "\n  next: " in written.err
    assert "→" not in written.err
    # Nothing is left of it: the next one gets the same place.
    with pytest.raises(SystemExit):
        server.module.main([server.place_option, place, "--help"])
    assert not [path for path in tmp_path.iterdir() if path.is_socket()]


def test_an_address_in_use_leads_to_one_that_is_free() -> None:
    port = 29000 + os.getpid() % 900
    with listen("127.0.0.2", port), pytest.raises(PluginError, match="in use") as caught:
        listen("127.0.0.2", port)
    (free,) = [word.strip(",") for word in caught.value.hint.split() if word.startswith("127.")]
    assert free != "127.0.0.2"
    listen(loopback_of(free), port).close()


@pytest.mark.parametrize(
    ("words", "request_"),
    [
        (["state"], {"do": "state"}),
        (["fault", "protective_stop"], {"do": "fault", "kind": "protective_stop"}),
        (["fault", "kind=late", "by_s=0.2"], {"do": "fault", "kind": "late", "by_s": 0.2}),
        (["pendant", "unlock"], {"do": "pendant", "press": "unlock"}),
        (["speed", "10"], {"do": "speed", "factor": 10}),
        (["push", "torque=[0, 20, 0, 0, 0, 0]"], {"do": "push", "torque": [0, 20, 0, 0, 0, 0]}),
        (["mount", "mass_kg=null"], {"do": "mount", "mass_kg": None}),
    ],
)
def test_words_of_a_shell_are_a_request(words: list[str], request_: dict[str, Any]) -> None:
    assert ur_mock.TELL.request(words[0], words[1:]) == request_


@pytest.mark.parametrize("words", [["state", "now"], ["fault", "a", "b"], ["clear", "=1"]])
def test_words_that_are_no_request_are_refused(server: Server, words: list[str]) -> None:
    with pytest.raises(SpecError, match="not KEY=VALUE"):
        server.tell.request(words[0], words[1:])


def test_send_says_how_to_start_a_mock_where_none_runs(
    name: str, server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = str(tmp_path / "can.sock") if name == "can" else loopback()
    assert server.module.main(["send", server.place_option, place, "state"]) == 4
    said = capsys.readouterr().err
    assert f"no {server.tell.who}" in said
    assert f"next: start one: hil mock {name}" in said


def test_the_former_name_of_send_is_accepted(
    name: str, server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = str(tmp_path / "can.sock") if name == "can" else loopback()
    assert server.module.main(["tell", server.place_option, place, "state"]) == 4
    assert f"no {server.tell.who}" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        server.module.main(["--help"])
    assert "tell" not in capsys.readouterr().out


# The side channel


@pytest.mark.wire
def test_a_shell_asks_for_a_fault_and_its_end(
    server: Server, running: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    def ask(*words: str, code: int = 0) -> Any:
        assert server.module.main(["send", *server.here(running), *words]) == code
        written = capsys.readouterr()
        return written.err if code else json.loads(written.out)

    assert ask("fault", server.lasting) == {"fault": server.lasting}
    until(lambda: ask("state")["faults"] == [server.lasting])
    ask("clear")
    until(lambda: ask("state")["faults"] == [])
    assert "\n  next: " in ask("fault", "quake", code=4)
    if server.journal_has_faults:
        assert running.journal("fault")[-1]["kind"] == server.lasting


@pytest.mark.wire
def test_the_side_channel_tells_the_truth_and_answers_mistakes_in_words(
    server: Server, running: Any
) -> None:
    place = server.side_of(running)
    before = server.tell.ask(place, {"do": "state"})
    assert len(before["q"]) == 6
    assert before["mounted_kg"] == before["declared_kg"] == 0.0
    server.tell.ask(place, {"do": "mount", "mass_kg": 3.0, "com_m": [0.0, 0.0, 0.05]})
    assert server.tell.ask(place, {"do": "state"})["mounted_kg"] == 3.0
    server.tell.ask(place, {"do": "mount", "mass_kg": None})
    for request in (
        {"do": "dance"},
        {"do": "fault", "kind": "quake"},
        {"do": "push", "torque": [1]},
        {"do": "mount", "mass_kg": -1},
    ):
        with pytest.raises(CommandRefused) as refused:
            server.tell.ask(place, request)
        assert refused.value.hint
    family = socket.AF_UNIX if isinstance(place, str) else socket.AF_INET
    with socket.socket(family) as line:
        line.settimeout(30.0)
        line.connect(place)
        line.sendall(b'not json\n[1]\n{"do": 3}\n')
        with line.makefile("r", encoding="utf-8") as answers:
            assert all("error" in json.loads(answers.readline()) for _ in range(3))
    after = server.tell.ask(place, {"do": "state"})
    assert after["mounted_kg"] == 0.0


# The process


@pytest.mark.wire
def test_one_place_is_for_one_mock_and_others_are_beside_it(
    name: str, server: Server, running: Any, tmp_path: Path
) -> None:
    command = command_of(name, [server.place_option, server.place_of(running)])
    second = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert second.returncode == 2
    assert "ready" not in second.stdout
    said = second.stderr
    assert "\n  next: " in said
    assert "in use" in said or "is taken" in said
    with server.run(tmp_path, "--seed", "2") as other:
        server.tell.ask(server.side_of(other), {"do": "fault", "kind": server.lasting})
        until(lambda: server.tell.ask(server.side_of(other), {"do": "state"})["faults"])
    assert server.tell.ask(server.side_of(running), {"do": "state"})["faults"] == []


@pytest.mark.wire
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_it_with_the_last_line_of_its_journal(
    server: Server, how: signal.Signals, tmp_path: Path
) -> None:
    with server.run(tmp_path) as mock:
        side = server.side_of(mock)
        assert mock.end(how) == 0
    assert mock.journal()[-1]["event"] == "closed"
    assert mock.journal()[-1]["pid"] == mock.process.pid
    assert {path.name for path in tmp_path.iterdir()} <= {"journal", "can.sock.lock"}
    with pytest.raises(RobotConnectionError, match=f"no {server.tell.who}"):
        server.tell.ask(side, {"do": "state"})


@pytest.mark.wire
def test_one_that_was_killed_leaves_its_place_to_the_next(server: Server, tmp_path: Path) -> None:
    with server.run(tmp_path) as killed:
        killed.end(signal.SIGKILL)
    place = server.place_of(killed)
    with server.run(tmp_path, place=place) as mock:
        assert server.tell.ask(server.side_of(mock), {"do": "state"})["faults"] == []
    opened = {line["pid"] for line in mock.journal()}
    assert mock.process.pid in opened


@pytest.mark.wire
def test_a_plan_of_faults_strikes_at_its_time(server: Server, tmp_path: Path) -> None:
    plan = tmp_path / "faults.yaml"
    plan.write_text(f"- {{kind: {server.lasting}, at_s: 0.2}}\n")
    with server.run(tmp_path, "--faults", str(plan)) as mock:
        side = server.side_of(mock)
        until(lambda: server.tell.ask(side, {"do": "state"})["faults"] == [server.lasting])
    if server.journal_has_faults:
        (fault,) = mock.journal("fault")
        assert fault["kind"] == server.lasting
        assert fault["device_time"] >= 0.19
