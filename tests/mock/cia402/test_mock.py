"""The mock drives together: station, loop, faults and journal, in a thread on a virtual bus."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil_mock_robot.cia402.mock import HostedMock, mock_on_virtual_bus
from hil_mock_robot.server.journal import read_journal
from tests.support.can_master import RPDO1, Master

PATIENT = 10.0
"""Wall time without SYNC that changes nothing: results do not depend on how busy we are."""
ARM = load_arm("lab6")
COUNTS = ARM.gear_ratio * 2**20 / (2 * math.pi)
ENABLE, QUICK_STOP = 0x0F, 0x02
_numbers = itertools.count(1)


@contextmanager
def mock(**options: object) -> Iterator[tuple[HostedMock, Master]]:
    channel = f"can-mock-{next(_numbers)}"
    options = {"patience_s": PATIENT, **options}
    with (
        mock_on_virtual_bus(channel, **options) as drives,  # type: ignore[arg-type]
        can.Bus(interface="virtual", channel=channel) as bus,
    ):
        yield drives, Master(bus)


def follow(master: Master, start: list[int], end_rad: float, cycles: int) -> None:
    """All axes by a cosine to `end_rad` from where they are."""
    for k in range(1, cycles + 1):
        way = end_rad * (1 - math.cos(math.pi * k / cycles)) / 2
        assert master.cycle(
            ENABLE, [s + round(way * c) for s, c in zip(start, COUNTS, strict=True)]
        )


def test_six_axes_follow_set_points_by_sync() -> None:
    with mock() as (drives, master):
        master.map()
        held = master.enable()
        before = drives.tell("state")
        follow(master, held, 0.2, 200)
        for _ in range(25):
            master.cycle(ENABLE, [h + round(0.2 * c) for h, c in zip(held, COUNTS, strict=True)])
        after = drives.tell("state")
        assert np.subtract(after["q"], before["q"]) == pytest.approx([0.2] * 6, abs=2e-3)
        assert after["device_time"] - before["device_time"] == pytest.approx(225 * 0.004)
        assert after["states"] == ["OPERATION_ENABLED"] * 6
        assert master.position == pytest.approx(
            [h + 0.2 * c for h, c in zip(held, COUNTS, strict=True)], abs=2e-3 * COUNTS.max()
        )


def events(path: Path) -> list[tuple[str, object]]:
    """What happened, and who or what did it."""
    lines = read_journal(path)
    keys = ("by", "kind", "after", "axes")
    return [(line["event"], next((line[k] for k in keys if k in line), None)) for line in lines]


def test_the_journal_tells_of_commands_faults_and_rest(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    with mock(journal=journal) as (drives, master):
        master.map()
        held = master.enable()
        follow(master, held, 0.1, 50)
        drives.tell("fault", kind="following_error", axis=4)
        for _ in range(60):
            master.cycle(QUICK_STOP, master.position)
    beside = ("nmt", "booted", "sync", "motion_over", "disable")
    told = [each for each in events(journal) if each[0] not in beside]
    assert told == [
        ("enable", [1, 2, 3, 4, 5, 6]),
        ("start", None),
        ("fault", "following_error"),
        ("emergency", None),
        ("stop", "fault"),
        ("stop", "quick stop"),
        ("rest", "fault"),
        ("closed", None),
    ]
    emergency = next(line for line in read_journal(journal) if line["event"] == "emergency")
    assert (emergency["axis"], emergency["code"]) == (4, "8611")


def test_set_points_that_change_are_motions_where_no_master_announces_them() -> None:
    began: list[bool] = []
    with mock() as (drives, master):
        drives.ask(lambda it: it.motions.listeners.append(began.append))
        master.map()
        held = master.enable()
        for _ in range(2):
            follow(master, held, 0.02, 10)
            for _ in range(40):
                master.cycle(ENABLE, held)
    assert began == [True, False, True, False]


@pytest.mark.thorough
def test_what_the_payload_objects_say_hangs_at_the_flange() -> None:
    with mock() as (drives, master):
        for sub, value in enumerate((3.0, 0.0, 0.01, 0.05), start=1):
            master.download(1, 0x2100, sub, "f", value)
        state = drives.tell("state")
        assert (state["declared_kg"], state["mounted_kg"]) == (3.0, 3.0)
        for _ in range(10):
            master.cycle(0, [0] * 6)
        hanging = drives.ask(lambda it: it.station.body.mounted)
        assert hanging.mass == 3.0
        assert hanging.com == pytest.approx((0.0, 0.01, 0.05))


def test_what_really_hangs_there_is_not_changed_by_what_is_declared() -> None:
    with mock(mounted=Payload(1.0, (0.0, 0.0, 0.1))) as (drives, master):
        master.download(1, 0x2100, 1, "f", 3.0)
        state = drives.tell("state")
        assert (state["declared_kg"], state["mounted_kg"]) == (3.0, 1.0)
        drives.tell("mount", mass_kg=None)
        assert drives.tell("state")["mounted_kg"] == 3.0


def test_drives_have_the_node_ids_that_were_asked_for() -> None:
    with mock(nodes=(11, 12, 13, 14, 15, 16)) as (_, master):
        other = Master(master.bus, range(11, 17))
        assert [other.upload(node, 0x1018, 4) for node in other.nodes] == [
            402_001, 402_002, 402_003, 402_004, 402_005, 402_006,
        ]  # fmt: skip
        with pytest.raises(TimeoutError):
            master.upload(1, 0x1000, within_s=0.1)


def test_a_process_data_object_may_have_another_identifier() -> None:
    with mock() as (drives, master):
        master.map()
        held = master.enable()
        master.nmt(0x80, 3)
        master.download(3, 0x1400, 1, "I", 0x8000_0203)
        master.download(3, 0x1400, 1, "I", 0x0000_0333)
        master.nmt(0x01, 3)
        master.cycle(ENABLE, held)
        master.send(0x333, RPDO1.pack(QUICK_STOP, 8, held[2]))
        master.cycle(ENABLE, held)
        master.cycle(ENABLE, held)
        assert [status & 0x6F == 0x27 for status in master.status] == [True] * 2 + [False] + [
            True
        ] * 3
        assert drives.tell("state")["states"][2] != "OPERATION_ENABLED"


@pytest.mark.wire
def test_without_sync_heartbeats_go_by_the_drives_own_timer() -> None:
    with mock(patience_s=0.02) as (_, master):
        master.download(2, 0x1017, 0, "H", 20)
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            master.hear(0.01)
        assert 15 <= len(master.heartbeats[2]) <= 27


def test_requests_that_cannot_be_are_answered_in_words() -> None:
    with mock() as (drives, _):
        for request in ({"do": "quake"}, {"do": 3}, {}):
            with pytest.raises(SpecError, match="does not know"):
                drives.ask(lambda it, request=request: it.requests.answer(request))
        answer = drives.ask(lambda it: it.requests.line(b"{no json"))
        assert "no JSON" in answer["error"]
        with pytest.raises(SpecError, match="6 numbers"):
            drives.tell("push", torque=[1.0])
