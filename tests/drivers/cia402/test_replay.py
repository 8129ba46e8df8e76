"""A log of the bus and the recording of a run: the one can be made from the other."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hil.can.frames import Frame
from hil.core.errors import DataError, PluginError
from hil.importers.sources import load_source
from hil.workflow.replaying import replay
from hil_drivers.cia402.mapping import POSITION
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.replay import BusCycles, Replay
from hil_drivers.cia402.rows import INCOMPLETE
from tests.support.cia402_robot import options
from tests.support.mock_servers import mock_can

NODES = range(1, 7)
OPTIONS = {
    "bus": {"interface": "hil_unix", "channel": "nowhere"},
    "nodes": list(NODES),
    "temperature_object": 0x2110,
}


def cycle(position: int, *, without: int = 0, target: int = 0) -> list[Frame]:
    """SYNC, commands and answers of one cycle; a frame can be left out."""
    frames = [Frame(0x080, b"", 1.0)]
    frames += [Frame(0x200 + n, struct.pack("<Hbi", 15, 8, target)) for n in NODES]
    frames += [Frame(0x180 + n, struct.pack("<Hib", 0x1237, position + n, 8)) for n in NODES]
    frames += [Frame(0x280 + n, struct.pack("<ihh", 5, 7, 9)) for n in NODES]
    return [frame for frame in frames if frame.id != without]


def records(frames: list[Frame]) -> Any:
    made = BusCycles(options_of(OPTIONS, "lab6"), POSITION).blocks(frames)
    return np.concatenate(list(made))


def test_a_sync_its_commands_and_its_answers_make_a_record() -> None:
    found = records([*cycle(100, target=3), *cycle(200, target=4)])
    assert found["cycle"].tolist() == [0, 1]
    assert found["flags"].tolist() == [0, 0]
    answers = np.ascontiguousarray(found["tpdo"][:, 0]).view(POSITION.tpdos[0].dtype)[..., 0]
    assert answers["position"][1].tolist() == [200 + n for n in NODES]
    commands = np.ascontiguousarray(found["rpdo"][:, 0]).view(POSITION.rpdos[0].dtype)[..., 0]
    assert commands["target_position"][:, 0].tolist() == [3, 4]


def test_what_the_master_announces_is_known_from_the_next_sync_on() -> None:
    marker = Frame(0x180 + 127, struct.pack("<iH", 12, 1))
    found = records([*cycle(0), marker, *cycle(0), *cycle(0)])
    assert found["segment"].tolist() == [-1, 12, 12]
    assert found["status"].tolist() == [0, 1, 1]


def test_a_lost_answer_leaves_what_was_before_and_says_whose_it_is() -> None:
    found = records([*cycle(100), *cycle(200, without=0x283), *cycle(300)])
    assert found["flags"].tolist() == [0, 1 << 2, 0]
    assert found["flags"][1] & INCOMPLETE


def test_a_temperature_is_known_from_the_sync_after_it_was_told() -> None:
    told = Frame(0x584, struct.pack("<BHBhH", 0x4B, 0x2110, 0, 305, 0))
    found = records([*cycle(0), told, *cycle(0)])
    assert np.isnan(found["temperature"][0]).all()
    assert found["temperature"][1, 3] == pytest.approx(30.5)
    assert np.isnan(found["temperature"][1, 4])


def test_an_emergency_is_the_fault_of_the_records_until_it_is_over() -> None:
    struck, over = (Frame(0x082, struct.pack("<HB5x", code, 1)) for code in (0x8611, 0))
    found = records([*cycle(0), struck, *cycle(0), over, *cycle(0)])
    assert found["fault_code"].tolist() == [0, 0x8611, 0]


def test_a_log_of_something_else_is_told(tmp_path: Path) -> None:
    log = tmp_path / "other.log"
    log.write_text("(1.000000) can0 701#05\n")
    robot = {"identity": {"details": DETAILS}}
    with pytest.raises(DataError, match="contains no SYNC"):
        list(Replay(log, "lab6", OPTIONS, robot).blocks())


def test_a_run_that_does_not_say_what_integers_mean_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "any.log"
    log.write_text("")
    with pytest.raises(DataError, match=r"start\.json.*axis 1"):
        Replay(log, "lab6", OPTIONS, {"identity": {"details": {}}})


DETAILS = {
    name: " ".join([str(value)] * 6)
    for name, value in {
        "encoder_increments": 1 << 20, "encoder_revolutions": 1, "gear_shaft": 1,
        "rated_current": 2000, "rated_torque": 1300, "polarity": 0,
    }.items()
}  # fmt: skip
DETAILS["gear_motor"] = "121 141 121 81 81 51"

SPEC = {
    "hil": 1,
    "name": "logged",
    "robot": "lab6_can",
    "excitation": {
        "kind": "fourier", "trajectories": 1, "harmonics": 2, "fundamental_hz": 0.5, "seed": 7,
        "max_velocity_deg_s": 60, "max_acceleration_deg_s2": 300,
    },
    "warm_up": {"duration_s": 0},
    "reference": {"every": 0},
}  # fmt: skip


def station(folder: Path, driver: str, given: dict[str, Any]) -> None:
    robot = {"driver": driver, "model": "lab6", "options": given}
    text = yaml.safe_dump({"hil_station": 1, "robots": {"lab6_can": robot}})
    (folder / "station.yaml").write_text(text, "utf-8")


def hil(folder: Path, *arguments: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "hil", *arguments, "--runs", "runs", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


@pytest.mark.wire
def test_the_log_of_a_run_replays_into_the_same_dataset(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(SPEC), "utf-8")
    with mock_can("--sync-patience-s", "1") as mock:
        given = options(mock, pace="free", candump=str(tmp_path / "bus.log"))
        station(tmp_path, "cia402", given)
        hil(tmp_path, "run", "spec.yaml", "--station", "station.yaml")
    again = hil(tmp_path, "replay", "1", "bus.log")
    # How late the host was is judged by its clock, which a log tells to the microsecond only.
    for name in ("samples", "gaps", "missing", "duplicates"):
        assert again["counts"][name] == again["recorded"][name]
    (recorded,) = (tmp_path / "runs").glob("*/*/0001-*")
    first, second = load_source(recorded), load_source(tmp_path / again["run"])
    assert len(first) > 400
    assert first.offsets.tolist() == second.offsets.tolist()
    for name, values in first.columns.items():
        np.testing.assert_array_equal(values, second.columns[name], err_msg=name)
    start = json.loads((tmp_path / again["run"] / "start.json").read_text())
    assert start["replayed"]["log"] == "bus.log"
    lines = (tmp_path / "bus.log").read_text().splitlines(keepends=True)
    wrong = {
        "half": lines[: len(lines) // 2],
        "late": [line for n, line in enumerate(lines) if n > len(lines) // 2],
        "deaf": [line for line in lines if " 181#" not in line],
    }
    for name, kept in wrong.items():
        (tmp_path / name).write_text("".join(kept))
        with pytest.raises(DataError, match="contains only a part of the data of the run"):
            replay(recorded, tmp_path / name, tmp_path / "runs")
        (made,) = (tmp_path / "runs").glob(f"*/*/000{3 + list(wrong).index(name)}-*")
        assert json.loads((made / "stop.json").read_text())["outcome"] == "failed"


@pytest.mark.thorough
def test_only_drivers_whose_wire_tells_all_replay(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(SPEC | {"robot": "lab6"}), "utf-8")
    hil(tmp_path, "run", "spec.yaml")
    (run,) = (tmp_path / "runs").glob("*/*/0001-*")
    with pytest.raises(PluginError, match="mock"):
        replay(run, tmp_path / "spec.yaml", tmp_path / "runs")
