"""RTDE rows as the base robot record and the further topic."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.recording.mcap_writer import require_rows_of
from hil.robot import Status, state_dtype
from hil_drivers.ur.rtde import FIELDS, Layout, names_for
from hil_drivers.ur.rtde import TYPES as WIRE_TYPES
from hil_drivers.ur.state import (
    further_rows,
    further_topic,
    program_running,
    require_source,
    state_rows,
)

TYPES = {field.name: field.type for field in FIELDS}
MASKED_FAULT = Status.MASKED | Status.FAULT


def raw(count: int = 1, without: tuple[str, ...] = (), **values: object) -> np.ndarray:
    """Rows as the receiver gives them, of a healthy arm at rest; each output has its own value."""
    names = [name for name in TYPES if name not in without]
    rows = np.zeros(count, Layout(1, names, [TYPES[name] for name in names]).dtype)
    for number, name in enumerate(names, 1):
        rows[name] = number
    healthy = {"robot_mode": 7, "safety_mode": 1, "runtime_state": 2, "target_qd": 0.0}
    for name, value in (healthy | values).items():
        if name in names:
            rows[name] = value
    return rows


@pytest.mark.parametrize(
    ("field", "output"),
    [
        ("device_time", "timestamp"),
        ("q", "actual_q"),
        ("qd", "actual_qd"),
        ("effort", "actual_current"),
        ("temperature", "joint_temperatures"),
        ("q_target", "target_q"),
        ("qd_target", "target_qd"),
        ("qdd_target", "target_qdd"),
        ("effort_target", "target_current"),
    ],
)
def test_each_output_becomes_its_field(field, output):
    rows = raw(2)
    state = state_rows(rows)
    assert state.dtype == state_dtype(6)
    assert np.array_equal(state[field], rows[output])
    assert state["segment"].tolist() == [-1, -1]


def test_the_torque_source_decides_what_the_effort_is():
    rows = raw()
    torque = state_rows(rows, "current-as-torque")
    assert np.array_equal(torque["effort"], rows["actual_current_as_torque"])
    assert np.array_equal(torque["effort_target"], rows["target_moment"])
    assert np.array_equal(state_rows(rows, "target-moment")["effort"], rows["target_moment"])


def test_a_torque_source_that_the_controller_lacks_is_refused():
    _, missing = names_for(3)
    with pytest.raises(SpecError, match="does not send: no CB3"):
        require_source("current-as-torque", missing)
    require_source("current", missing)


def test_what_is_missing_is_nan_and_no_fault():
    state = state_rows(raw(without=("joint_temperatures", "safety_mode", "robot_mode")))
    assert np.isnan(state["temperature"]).all()
    assert state["status"] == Status.HOLDING
    assert state["fault_code"] == 0


@pytest.mark.parametrize(
    ("values", "status"),
    [
        ({}, Status.HOLDING),
        ({"target_qd": [0, 0, 0, 0.1, 0, 0]}, Status.MOVING),
        ({"safety_mode": 2}, Status.HOLDING),
        ({"safety_mode": 3}, Status.HOLDING | MASKED_FAULT),
        ({"safety_mode": 7, "robot_mode": 3}, Status.HOLDING | MASKED_FAULT),
        ({"robot_mode": 5}, Status.HOLDING | Status.MASKED),
        ({"robot_mode": 6}, Status.HOLDING | Status.MASKED),
    ],
)
def test_status_says_moving_holding_fault_and_what_must_not_be_used(values, status):
    state = state_rows(raw(**values))
    assert state["status"] == status
    safety = values.get("safety_mode", 1)
    assert state["fault_code"] == (safety if safety > 2 else 0)
    assert state["mode"] == values.get("robot_mode", 7)


def test_the_measured_velocity_tells_holding_where_none_is_commanded():
    assert state_rows(raw(without=("target_qd",), actual_qd=0.2))["status"] == Status.MOVING


def test_everything_else_is_recorded_as_it_came_in_a_topic_that_is_always_the_same():
    topic = further_topic(125.0)
    rows = raw(3)
    further = further_rows(rows, topic)
    require_rows_of({topic.name: topic}, topic.name, further)
    told = {"timestamp", "actual_q", "actual_qd", "joint_temperatures"}
    told |= {"target_q", "target_qd", "target_qdd"}
    assert {name.lower() for name in TYPES if name not in told} == set(further.dtype.names[2:])
    for name in set(TYPES) - told:
        assert np.array_equal(further[name.lower()], rows[name]), name


def test_what_the_controller_lacks_is_nan_or_minus_one_in_the_topic():
    lacking = ("payload", "tcp_offset", "safety_status", "script_control_line")
    further = further_rows(raw(without=lacking), further_topic(500.0))[0]
    assert np.isnan(further["payload"])
    assert np.isnan(further["tcp_offset"]).all()
    assert further["safety_status"] == -1
    assert further["script_control_line"] == 2**32 - 1


def test_a_program_runs_until_it_stops_also_while_paused():
    rows = raw(6)
    rows["runtime_state"] = range(6)
    assert program_running(rows).tolist() == [False, False, True, True, True, True]
    assert not program_running(raw(without=("runtime_state",))).any()


def test_fields_are_sorted_by_width_so_that_a_few_copies_make_rows_of_packages():
    widths = [np.dtype(WIRE_TYPES[kind][0]).itemsize for kind in TYPES.values()]
    assert widths == sorted(widths, reverse=True)


def test_the_question_for_all_of_them_is_short_enough():
    assert len(",".join(TYPES)) < 2048
