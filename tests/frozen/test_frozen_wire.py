"""Recordings of robots on the wire, and commands about a run that goes on, are as they were."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.frozen.frozen_parts import command, compare, layout, run_of, told
from tests.support.mock_servers import mock_can, mock_plc, mock_ur

SCRIPTS = 30002
PROGRAM = """\
def work():
  while True:
    movej([0.1, -1.4, 0.2, -1.3, 0.1, 0], a=4, v=2)
    sleep(0.4)
    movej([-0.1, -1.7, -0.2, -1.6, -0.1, 0], a=4, v=2)
    sleep(0.4)
  end
end
"""

pytestmark = [pytest.mark.wire, pytest.mark.timeout(180)]


def same_layout(lab: Path, name: str, station: str) -> None:
    """Run an experiment of the sample again; its recording has the same topics and schemas."""
    Path("specs/wire.yaml").write_text(station, "utf-8")
    was = run_of(lab, f"frozen-{name}")
    told("run", f"specs/{name}.yaml", "--station", "specs/wire.yaml")
    now = run_of(lab, f"frozen-{name}")
    assert now != was
    assert layout(now / "recording/00.mcap") == layout(was / "recording/00.mcap")


def station(lab: Path) -> str:
    return (lab / "specs/wire.yaml").read_text("utf-8")


def test_a_recording_of_a_ur_arm(lab: Path) -> None:
    with mock_ur("--speed", "10") as mock:
        same_layout(lab, "ur", station(lab).replace("127.0.0.21", mock.address))


def test_a_recording_of_drives_on_a_bus_between_processes(lab: Path) -> None:
    with mock_can("--bitrate", "1000000") as mock:
        same_layout(
            lab, "can", station(lab).replace("channel: frozen0", f"channel: {mock.channel}")
        )


def test_a_recording_of_an_arm_behind_a_plc(lab: Path, tmp_path: Path) -> None:
    with mock_plc(tmp_path) as mock:
        same_layout(lab, "plc", station(lab).replace("127.0.0.22", mock.address))


def test_a_recording_of_somebody_elses_program(lab: Path) -> None:
    with mock_ur() as mock:
        text = station(lab).replace("127.0.0.23", mock.address)
        Path("specs/wire.yaml").write_text(text, "utf-8")
        with mock.connect(SCRIPTS) as line:
            line.sendall(PROGRAM.encode())
            time.sleep(0.3)
        code, out = command(
            "record", "--robot", "ur5-passive", "--station", "specs/wire.yaml", "--for", "3s",
            "--payload", "0", "--name", "frozen-passive", "--json",
        )  # fmt: skip
    frozen = lab / "json/exit-codes.json"
    frozen.write_text(json.dumps(json.loads(frozen.read_text("utf-8")) | {"record": 0}), "utf-8")
    compare("record", code, out, lab)
    was, now = sorted(lab.glob("runs/*/*/*-frozen-passive"), key=lambda run: run.name)
    assert layout(now / "recording/00.mcap") == layout(was / "recording/00.mcap")


def test_documents_of_commands_about_a_run_that_goes_on(lab: Path) -> None:
    words = ["run", "specs/live.yaml", "--station", "specs/bench.yaml", "--no-console", "--json"]
    process = subprocess.Popen(
        [sys.executable, "-m", "hil", *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        text=True,
    )  # fmt: skip
    try:
        for name, asked in {
            "answer": ["answer", "frozen-live", "yes"],
            "pause": ["pause", "frozen-live"],
            "resume-paused": ["resume", "frozen-live"],
            "stop": ["stop", "frozen-live"],
        }.items():
            code, out = command(*asked, "--json")
            while code and process.poll() is None:  # until there is the run, and its question
                code, out = command(*asked, "--json")
            compare(name, code, out, lab)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    compare("run-stopped", process.returncode, out, lab)
