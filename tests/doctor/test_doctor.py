"""`hil doctor`: what it says of a computer, and of robots that are there or not."""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.doctor import computer, examine, packages
from hil.doctor.examination import station_robots
from hil.doctor.finding import Finding
from hil_drivers.ur import controller as ur_controller


def level_of(findings: Iterator[Finding]) -> str:
    return max((one.level for one in findings), key=["ok", "note", "bad"].index)


def test_doctor_tells_what_networks_are_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def told(version: str | None, torch: object) -> list[Finding]:
        def asked(name: str) -> str:
            if version is None:
                raise PackageNotFoundError(name)
            return version

        monkeypatch.setattr(packages.importlib.metadata, "version", asked)
        monkeypatch.setitem(sys.modules, "torch", torch)
        return list(packages.torch())

    gpu = SimpleNamespace(
        cuda=SimpleNamespace(device_count=lambda: 1, get_device_name=lambda i: f"GPU {i}")
    )
    assert told(None, None) == []
    assert told("2.13.0+cpu", None) == [
        Finding("torch", "2.13.0+cpu: networks are trained on the CPU")
    ]
    assert told("2.13.0", gpu) == [Finding("torch", "2.13.0: networks are trained on GPU 0")]
    (broken,) = told("2.13.0", None)
    assert (broken.level, "cannot be used" in broken.finding) == ("note", True)


@pytest.mark.parametrize(
    ("version", "bounds", "fits"),
    [
        ("2.13.0+cpu", ">=2.5", True),
        ("2.4.9", ">=2.5", False),
        ("3.11.3", ">=3.11,<4", True),
        ("4.0", ">=3.11,<4", False),
        ("2026.8.0", ">=2025.1", True),
        ("1.0", "", True),
    ],
)
def test_versions_are_compared_by_their_numbers(version: str, bounds: str, fits: bool) -> None:
    assert packages.meets(version, bounds) is fits


def test_a_package_too_old_is_bad_in_the_core_and_a_note_in_an_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wanted = ["numpy>=9999", 'torch>=9999; extra == "learn"', 'ruff>=9999; extra == "dev"']
    monkeypatch.setattr(packages.importlib.metadata, "requires", lambda name: wanted)
    (core,) = packages.core()
    assert core.level == "bad"
    assert "is not >=9999" in core.finding
    (extra,) = packages.extras()
    assert (extra.what, extra.level) == ("extra learn", "note")
    assert 'pip install "hil[learn]"' in extra.finding


def test_an_extra_that_is_not_for_this_python_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ["ur-rtde>=1.6; python_version < '3.0' and extra == 'ur'"]
    monkeypatch.setattr(packages.importlib.metadata, "requires", lambda name: wanted)
    (told,) = packages.extras()
    assert "only for Python before 3.0" in told.finding


def test_other_versions_than_those_tested_are_named(tmp_path: Path) -> None:
    tested = tmp_path / "constraints.txt"
    tested.write_text("numpy==0.1\nno-such-package==1\n", "utf-8")
    (told,) = packages.constraints(tested)
    assert told.level == "note"
    assert "(tested: 0.1)" in told.finding
    assert "no-such-package" not in told.finding
    assert list(packages.constraints(tmp_path / "none")) == []


def test_folders_that_cannot_be_written_are_bad_and_nothing_is_made(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    monkeypatch.setenv("HIL_RUNS", str(tmp_path / "file" / "runs"))
    found = {one.what: one for one in computer.folders()}
    assert (found["runs"].level, found["leases"].level) == ("bad", "ok")
    assert "can be created" in found["leases"].finding
    assert os.listdir(tmp_path) == ["file"]


def test_a_serial_adapter_that_may_not_be_opened_is_noted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert list(computer.serial_adapters(tmp_path)) == []
    (tmp_path / "ttyUSB0").write_text("")
    assert level_of(computer.serial_adapters(tmp_path)) == "ok"
    monkeypatch.setattr(os, "access", lambda *_: False)
    (told,) = computer.serial_adapters(tmp_path)
    assert "dialout" in told.finding


def test_a_taken_port_is_noted_with_what_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        monkeypatch.setattr(computer, "PORTS", {"dashboard": ((number,), "takes another")})
        (told,) = computer.ports()
        assert told == Finding("ports dashboard", f"{number} in use: takes another", "note")
    assert level_of(computer.ports()) == "ok"


@pytest.mark.parametrize(("year", "level"), [(1970, "bad"), (2025, "note"), (2100, "ok")])
def test_a_date_that_cannot_be_is_told(
    monkeypatch: pytest.MonkeyPatch, year: int, level: str
) -> None:
    monkeypatch.setattr(computer.time, "time", lambda: (year - 1970) * 365.25 * 86400 + 43200)
    assert level_of(computer.date()) == level


def test_a_clock_that_nobody_keeps_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    for kept, level in ((True, "ok"), (False, "note"), (None, "note")):
        monkeypatch.setattr(computer, "_is_synchronised", lambda kept=kept: kept)
        assert level_of(computer.time_service()) == level


def test_more_blas_threads_than_cores_are_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert level_of(computer.blas_threads()) == "ok"
    monkeypatch.setattr(computer, "cores", lambda: 0)
    assert "OMP_NUM_THREADS=1" in next(computer.blas_threads()).finding


def test_can_interfaces_of_the_kernel_are_up_or_down(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(computer.socket, "AF_CAN", socket.AF_INET, raising=False)
    monkeypatch.setattr(computer.socket, "CAN_RAW", 0, raising=False)
    monkeypatch.setattr(computer.socket, "SOCK_RAW", socket.SOCK_STREAM)
    for name, kind, flags in (("can0", 280, "0x40081"), ("eth0", 1, "0x0")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "flags").write_text(f"{flags}\n")
    (told,) = computer.socketcan(tmp_path)
    assert (told.level, told.finding) == ("ok", "SocketCAN; interfaces: can0")
    (tmp_path / "can0" / "flags").write_text("0x40080\n")
    (told,) = computer.socketcan(tmp_path)
    assert told.level == "note"
    assert "ip link set can0 up" in told.finding


STATION = """\
hil_station: 1
name: bench
robots:
  inside: {driver: mock, model: ur5}
  away: {driver: ur, model: ur5, options: {address: 127.0.0.1}}
  plc: {driver: twincat, model: lab6, options: {address: "127.0.0.1:9"}}
  bus: {driver: cia402, model: lab6, options: {bus: {interface: socketcan, channel: can77},
        nodes: [1, 2, 3, 4, 5, 6]}}
"""


@pytest.fixture
def station(tmp_path: Path) -> Path:
    file = tmp_path / "station.yaml"
    file.write_text(STATION, "utf-8")
    return file


def serve_dashboard(answers: dict[str, str]) -> tuple[int, socket.socket]:
    """A dashboard server for as many conversations as come; its port."""
    server = socket.create_server(("127.0.0.1", 0))

    def talk() -> None:
        while True:
            try:
                line, _ = server.accept()
            except OSError:
                return
            with line, line.makefile("rw", encoding="utf-8", newline="\n") as file:
                try:
                    file.write("Connected: Universal Robots Dashboard Server\n")
                    file.flush()
                    for asked in file:
                        file.write(answers.get(asked.strip(), "could not understand") + "\n")
                        file.flush()
                except OSError:
                    continue

    Thread(target=talk, daemon=True).start()
    return server.getsockname()[1], server


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """What a controller's dashboard answers, on ports of its own."""
    answers = {
        "robotmode": "Robotmode: RUNNING",
        "safetymode": "Safetymode: NORMAL",
        "is in remote control": "true",
    }
    port, server = serve_dashboard(answers)
    monkeypatch.setattr(ur_controller, "DASHBOARD_PORT", port)
    monkeypatch.setattr("hil_drivers.ur.dashboard.DASHBOARD_PORT", port)
    monkeypatch.setattr(ur_controller, "PORTS", {port: "dashboard"})
    yield answers
    server.close()


def test_a_controller_is_asked_for_its_mode_and_its_control(controller: dict[str, str]) -> None:
    assert all(one.passed for one in ur_controller.reached("127.0.0.1"))
    controller |= {
        "robotmode": "Robotmode: IDLE",
        "safetymode": "Safetymode: PROTECTIVE_STOP",
        "is in remote control": "false",
    }
    missed = {one.name: one.message for one in ur_controller.reached("127.0.0.1") if not one.passed}
    assert missed == {
        "mode": "robot mode IDLE",
        "safety": "safety mode PROTECTIVE_STOP",
        "control": "in local control",
    }
    del controller["is in remote control"]  # an older controller knows no such thing
    assert "control" not in {one.name for one in ur_controller.reached("127.0.0.1")}


def test_robots_that_are_not_there_are_bad_and_say_how_to_mend(
    monkeypatch: pytest.MonkeyPatch, station: Path
) -> None:
    monkeypatch.setattr(ur_controller, "PORTS", {9: "dashboard"})
    monkeypatch.setattr(ur_controller, "DASHBOARD_PORT", 9)
    found = {one.what: one for one in station_robots(station)}
    assert found["station"].level == found["mock robots"].level == "ok"
    assert found["mock robots"].finding.startswith("inside:")
    silent = {name: found[name] for name in ("away: ports", "plc: port", "bus: bus")}
    assert {one.level for one in silent.values()} == {"bad"}
    assert "the controller is on" in silent["away: ports"].finding
    assert "no interface can77: plug the adapter in" in silent["bus: bus"].finding


def test_a_controller_that_says_nothing_is_waited_for_no_longer_than_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        monkeypatch.setattr(ur_controller, "PORTS", {port: "dashboard"})
        monkeypatch.setattr(ur_controller, "DASHBOARD_PORT", port)
        monkeypatch.setattr("hil_drivers.ur.dashboard.DASHBOARD_PORT", port)
        told = list(ur_controller.reached("127.0.0.1", within_s=0.1))
    assert (told[-1].name, told[-1].passed) == ("dashboard", False)


def test_a_station_that_is_wrong_is_one_bad_line(tmp_path: Path) -> None:
    assert level_of(station_robots(tmp_path / "none.yaml")) == "bad"


@pytest.mark.thorough
def test_something_bad_is_exit_code_1_and_one_document(station: Path) -> None:
    done = CliRunner().invoke(app, ["doctor", "--station", str(station), "--json"])
    document = json.loads(done.stdout)
    assert done.exit_code == 1
    assert {"what", "finding", "level"} == set(document[0])
    assert [one["what"] for one in document if one["level"] == "bad"]


@pytest.mark.thorough
def test_every_look_answers_here() -> None:
    found = examine()
    assert {"python", "packages", "runs", "clock", "real-time", "can"} <= {f.what for f in found}
    assert {one.level for one in found} <= {"ok", "note", "bad"}
