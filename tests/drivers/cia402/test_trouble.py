"""What the next read raises, and what drives are told beside their process data."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.core.errors import RobotFault
from hil.robot import Status
from hil_drivers.cia402.session import Trouble
from hil_mock_robot.cia402.keys import key
from tests.support.cia402_drives import drives

ROWS = np.array([(0,)], dtype=[("status", "<u2")])


def trouble_of(line: Any, problem: str, **samples: Any) -> Trouble:
    told = [problem, ""]
    core: Any = SimpleNamespace(take_problem=lambda: told.pop(0) if told else "")
    of_cycles: Any = SimpleNamespace(**({"faulty": [], "silent": []} | samples))
    return Trouble("arm", core, line.master, of_cycles)


def test_axes_that_process_data_do_not_reach_are_stopped_by_objects() -> None:
    with drives(2) as line:  # pre-operational: they take no RPDOs
        line.nodes[1].registers[key(0x6041)] = 0x0250
        trouble = trouble_of(line, "joint_2: has started anew", silent=[1])
        trouble.look(ROWS)
        assert [node.registers[key(0x6040)] for node in line.nodes] == [2, 2]
        with pytest.raises(RobotFault, match=r"6041h: joint_2 \(node 2\) switch on disabled"):
            trouble.raise_it()


@pytest.mark.parametrize(
    ("silent", "hint"), [([0, 1], "see to the bus"), ([1], "see to the cause")]
)
def test_where_nobody_answers_the_bus_is_what_to_look_at(silent: list[int], hint: str) -> None:
    with drives(2) as line:
        trouble = trouble_of(line, "has not answered", silent=silent)
        trouble.look(ROWS)
        with pytest.raises(RobotFault) as caught:
            trouble.raise_it()
        assert hint in caught.value.hint


def test_nothing_is_sent_while_all_is_well() -> None:
    with drives(2) as line:
        line.sent.clear()
        trouble_of(line, "").look(ROWS)
        assert [can_id for can_id, _ in line.sent if can_id >= 0x600] == []


def test_silent_drives_do_not_keep_a_fault_from_being_told() -> None:
    with drives(2) as line:
        line.lost = lambda can_id, _: can_id == 0x581
        line.nodes[1].registers[key(0x603F)] = 0x2310
        rows = ROWS.copy()
        rows["status"] = int(Status.FAULT)
        trouble = trouble_of(line, "joint_1: its heartbeat is overdue", faulty=[0, 1], silent=[0])
        began = time.monotonic()
        trouble.look(rows)
        with pytest.raises(RobotFault, match=r"603Fh: joint_2 \(node 2\) .*2310h") as caught:
            trouble.raise_it()
        assert time.monotonic() - began < 0.5
        assert "6041h" not in caught.value.message


def test_a_fault_told_by_an_emcy_alone_is_asked_for_once_all_axes_were_told_to_stop() -> None:
    """It comes before the process data that show it, so that no row says which axis it is."""
    with drives(2) as line:
        line.nodes[1].registers[key(0x6041)] = 0x0218
        line.nodes[1].registers[key(0x603F)] = 0x8611
        line.nodes[0].registers[key(0x603F)] = 0x8130  # its last error, long gone
        trouble = trouble_of(line, "joint_2 (node 2): following error (8611h)")
        line.sent.clear()
        trouble.look(ROWS)
        with pytest.raises(RobotFault, match=r"\(603Fh: joint_2 \(node 2\) [^;]*8611h\)\)\n"):
            trouble.raise_it()
        asked = [
            int.from_bytes(data[1:3], "little") for can_id, data in line.sent if can_id > 0x600
        ]
        assert asked == [0x6040, 0x6040, 0x6041, 0x6041, 0x603F]
