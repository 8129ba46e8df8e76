"""Complete is what the recorded rows prove, by the same rule the engine used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hil.core.typing import FloatArray, StructArray
from hil.engine.engine import DwellWatch
from hil.excitation.motion import FourierSeries
from hil.importers.completeness import (
    completeness_of,
    dwell_is_over,
    dwell_settles,
    step_is_complete,
)
from hil.planning.plan import DwellRule, Plan, Step
from hil.recording.mcap_writer import McapWriter
from hil.robot.state import STATE_TOPIC, Status, state_dtype, state_topic

RATE = 125.0
RULE = DwellRule(dwell_s=0.05, samples=4, settle_rad_s=0.002, timeout_s=0.3)


def dwell_rows(speed: FloatArray) -> StructArray:
    rows = np.zeros(len(speed), state_dtype(6))
    rows["device_time"] = 7.0 + np.arange(len(speed)) / RATE
    rows["qd"][:, 2] = speed
    return rows


speeds = hnp.arrays(np.float64, st.integers(1, 60), elements=st.sampled_from([0.0, 0.001, 0.01]))


@pytest.mark.thorough
@given(speeds)
@settings(max_examples=300, deadline=None)
def test_a_dwell_is_over_in_the_data_exactly_if_the_engine_called_it_over(
    speed: FloatArray,
) -> None:
    rows = dwell_rows(speed)
    watch = DwellWatch(RULE)
    ends = [i for i in range(len(rows)) if watch.feed(rows[i : i + 1])]
    assert dwell_is_over(rows, RULE) is bool(ends)


@given(speeds)
@settings(deadline=None)
def test_a_dwell_that_settled_for_the_engine_settles_in_the_data(speed: FloatArray) -> None:
    rows = dwell_rows(speed)
    watch = DwellWatch(RULE)
    settled = []
    for i in range(len(rows)):
        watch.feed(rows[i : i + 1])
        settled.append(watch.settled)
    assert dwell_settles(rows, RULE) is any(settled)


def trajectory() -> tuple[Step, Plan, StructArray]:
    zeros = ((0.0,) * 5,) * 6
    motion = FourierSeries(q0=(0.0,) * 6, a=zeros, b=zeros, fundamental_hz=0.5)
    step = Step(3, "trajectory", motion, trajectory=0)
    plan = Plan("p", "ur5", ("a",) * 6, RATE, (step,), ())
    n = round(plan.step_duration_s(step) * RATE)
    rows = np.zeros(n + 5, state_dtype(6))
    rows["device_time"] = np.arange(n + 5) / RATE
    rows["status"][:n], rows["status"][n:] = int(Status.MOVING), int(Status.HOLDING)
    return step, plan, rows


def test_a_trajectory_that_reached_its_end_is_complete() -> None:
    step, plan, rows = trajectory()
    assert step_is_complete(step, rows, plan)


@pytest.mark.parametrize("cut", [slice(None, -60), slice(60, None)])
def test_one_that_lacks_its_end_or_its_beginning_is_not(cut: slice) -> None:
    step, plan, rows = trajectory()
    assert not step_is_complete(step, rows[cut], plan)


def test_one_with_a_long_hole_is_not_and_one_with_a_lost_sample_is() -> None:
    step, plan, rows = trajectory()
    assert not step_is_complete(step, np.delete(rows, slice(100, 140)), plan)
    assert step_is_complete(step, np.delete(rows, 100), plan)


def recorded(rows: StructArray, path: Path) -> Path:
    with McapWriter(path, [state_topic(6, RATE, clock="wall", effort_unit="A")]) as writer:
        writer.write(STATE_TOPIC, rows)
    return path


@pytest.mark.parametrize("marked", [slice(0, 1), slice(200, None)])
def test_what_was_measured_at_another_speed_than_planned_is_to_be_measured_again(
    marked: slice, tmp_path: Path
) -> None:
    step, plan, rows = trajectory()
    rows["segment"], rows["host_time"] = step.index, rows["device_time"]
    assert completeness_of(plan, [recorded(rows, tmp_path / "00.mcap")]).missing == ()
    rows["status"][marked] |= int(Status.SLOWED)
    complete = completeness_of(plan, [recorded(rows, tmp_path / "01.mcap")])
    assert complete.missing == (step.index,)
    assert complete.slowed == {step.index}
