"""The mock drives as a process: real frames between two processes, in wall time."""

from __future__ import annotations

import math
import time
from pathlib import Path

import can
import numpy as np
import pytest

from hil.arms import load_arm
from tests.support.can_master import Master
from tests.support.mock_servers import mock_can

pytestmark = pytest.mark.wire

ARM = load_arm("lab6")
COUNTS = ARM.gear_ratio * 2**20 / (2 * math.pi)
ENABLE, QUICK_STOP = 0x0F, 0x02
PERIOD_S = 0.004
WAY_RAD = 0.3


def commanded(held: list[int], way: float) -> list[int]:
    return [h + round(way * c) for h, c in zip(held, COUNTS, strict=True)]


def swing(master: Master, held: list[int], cycles: int, stop_after: int | None = None) -> int:
    """All axes by a cosine in real time; returns how many cycles lacked answers."""
    due, lacking = time.monotonic(), 0
    for k in range(1, (stop_after or cycles) + 1):
        way = WAY_RAD * (1 - math.cos(math.pi * k / cycles)) / 2
        lacking += not master.cycle(ENABLE, commanded(held, way))
        due += PERIOD_S
        time.sleep(max(0.0, due - time.monotonic()))
    return lacking


def events(journal: list[dict[str, object]], *names: str) -> list[dict[str, object]]:
    return [line for line in journal if line["event"] in names]


@pytest.mark.journey
def test_six_axes_follow_set_points_between_two_processes(tmp_path: Path) -> None:
    with mock_can(journal=tmp_path / "journal") as mock, mock.bus() as bus:
        master = Master(bus)
        master.map()
        held = master.enable()
        before = mock.state()["q"]
        master.marker(0, 1)
        assert swing(master, held, 150) == 0
        master.marker(0, 2)
        for _ in range(40):
            master.cycle(ENABLE, commanded(held, WAY_RAD))
        after = mock.state()["q"]
        for _ in range(60):
            master.cycle(QUICK_STOP, commanded(held, WAY_RAD))
        assert mock.state()["states"] == ["SWITCH_ON_DISABLED"] * 6
        assert np.subtract(after, before) == pytest.approx([WAY_RAD] * 6, abs=3e-3)
        told = [line["event"] for line in mock.journal()]
    wanted = ["sync", "enable", "start", "motion_over", "rest", "stop"]
    assert [each for each in told if each in wanted] == wanted


def test_drives_whose_master_is_gone_stop_by_themselves(tmp_path: Path) -> None:
    with mock_can(journal=tmp_path / "journal") as mock:
        with mock.bus() as bus:
            master = Master(bus)
            master.map(heartbeat_ms=60)
            master.master_heartbeat = 5
            held = master.enable()
            swing(master, held, 200, stop_after=100)
        gone = time.monotonic()
        mock.wait_until(lambda state: "OPERATION_ENABLED" not in state["states"])
        mock.wait_until(lambda _: bool(events(mock.journal(), "rest")))
        journal = mock.journal()
    lost = events(journal, "connection_lost")
    assert {line["code"] for line in lost} == {"8130"}
    assert {line["axis"] for line in lost} == {1, 2, 3, 4, 5, 6}
    rest = events(journal, "rest")[-1]
    assert float(str(rest["monotonic_s"])) - gone < 1.0


def test_a_frame_takes_its_time_on_a_modelled_wire() -> None:
    with mock_can("--bitrate", "1e6") as mock, mock.bus() as bus:
        master = Master(bus)
        master.map()
        master.cycle(0, [0] * 6)
        took = []
        for _ in range(10):
            began = time.monotonic()
            assert master.cycle(0, [0] * 6)
            took.append(time.monotonic() - began)
        # SYNC, 6 RPDOs and 6 TPDOs of 7 bytes, 6 of 8: at least their bits without stuffing.
        assert min(took) >= (47 + 12 * (47 + 56) + 6 * (47 + 64)) * 1e-6


def test_any_tool_of_python_can_sees_the_bus() -> None:
    with mock_can() as mock, mock.bus() as bus:
        bus.send(can.Message(arbitration_id=0, data=[0x81, 4], is_extended_id=False))
        found = [bus.recv(1.0)]
        assert [(m.arbitration_id, bytes(m.data)) for m in found if m] == [(0x704, b"\x00")]
