"""Dwells and moves found while rows come, against what a whole recording shows afterwards."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hil.arms.payload import Payload
from hil.core.typing import StructArray
from hil.data.dwells import find_dwells
from hil.importers.passive_plan import MOST_HELD_BACK, DetectedSteps, Segmenter
from hil.importers.sources import dwell_rule_of, steps_of_plan
from tests.support.fuzzing import examples
from tests.support.passive_motion import GO, STAY, motion


def found(rows: StructArray, cuts: list[int]) -> StructArray:
    segmenter = Segmenter()
    pieces = [segmenter.feed(piece.copy()) for piece in np.split(rows, sorted(cuts))]
    held = segmenter.flush()
    return np.concatenate([*pieces, *([] if held is None else [held])])


def steps_of(rows: StructArray) -> list[dict]:
    steps = DetectedSteps()
    steps.add(rows)
    return steps.steps()


@examples(60)
@given(cuts=st.lists(st.integers(0, len(motion())), max_size=20))
def test_blocks_of_any_size_give_the_same_segments_and_no_row_is_lost(cuts):
    rows = motion()
    whole = found(rows, [])
    again = found(rows, cuts)
    assert again.tobytes() == whole.tobytes()
    assert np.array_equal(again["device_time"], rows["device_time"])


def test_stays_are_those_that_the_whole_recording_shows():
    rows = found(motion(), [100])
    dwells = find_dwells(rows["q"], rows["qd"], rows["device_time"])
    assert len(dwells) == 4
    for number, dwell in enumerate(dwells):
        assert set(rows["segment"][dwell]) == {2 * number + 1}


def test_the_last_rows_of_a_stay_are_at_rest_however_gently_the_motion_begins():
    rows = found(motion([(0.0, STAY), (0.3, 4.0)]), [52, 53])
    assert np.abs(rows["qd"][rows["segment"] == 1]).max() < 0.005
    assert set(rows["segment"]) == {1, 2, 3}


def test_even_segments_move_and_poses_come_again():
    steps = steps_of(found(motion(), []))
    kinds = [(step["kind"], step.get("pose"), step.get("approach")) for step in steps]
    dwells = [kind for kind in kinds if kind[0] == "dwell"]
    assert dwells == [
        ("dwell", 0, None), ("dwell", 1, 1), ("dwell", 2, -1), ("dwell", 1, 1),
    ]  # fmt: skip
    assert [kind[0] for kind in kinds] == ["move", "dwell"] * 4


def test_noise_below_twice_the_threshold_does_not_end_a_stay():
    rows = motion([(0.0, 0.4)] * 5)
    rows["qd"][60::7] = 0.009
    assert set(found(rows, [])["segment"]) == {1}


def test_a_short_halt_belongs_to_the_motion():
    rows = found(motion([(0.0, GO), (0.5, GO), (0.5, 0.05), (1.0, GO)]), [])
    assert [step["kind"] for step in steps_of(rows)] == ["move", "dwell", "move"]


def test_a_creeping_arm_does_not_stand_still():
    rows = motion([(0.0, 4.0)])
    rows["q"] += (rows["device_time"] * 0.0045 * 10)[:, None]
    rows["qd"][:] = 0.0045
    assert "dwell" not in [step["kind"] for step in steps_of(found(rows, []))]


def test_a_long_motion_is_a_trajectory_if_most_of_the_motion_is():
    long = [(0.0, STAY), *[(0.5 * (-1) ** i, 1.0) for i in range(15)], (0.0, STAY)]
    rows = motion(long)
    rows["qd"] += 0.1 * (np.abs(rows["qd"]) > 0)  # it turns without a halt
    middle = slice(60, len(rows) - 60)
    rows["qd"][middle] = np.maximum(np.abs(rows["qd"][middle]), 0.1)
    steps = steps_of(found(rows, []))
    assert [step["kind"] for step in steps if step["kind"] != "dwell"].count("trajectory") == 1
    assert "trajectory" not in [step["kind"] for step in steps_of(found(motion(), []))]


def test_an_arm_whose_clock_stands_still_is_not_held_back_for_ever():
    rows = motion([(0.0, 30.0)])
    rows["device_time"] = 1.0
    segmenter = Segmenter()
    assert len(segmenter.feed(rows[: MOST_HELD_BACK - 10])) == 0
    assert (
        len(segmenter.feed(rows[MOST_HELD_BACK - 10 : MOST_HELD_BACK + 10])) == MOST_HELD_BACK + 10
    )


def test_unknown_velocity_is_motion():
    rows = motion()
    rows["qd"] = np.nan
    assert set(found(rows, [50])["segment"]) == {0}


def test_the_passive_plan_says_what_steps_of_a_plan_say():
    robot = {"model": "ur5", "joint_names": ["a"] * 6, "rate_hz": 125.0}
    steps = DetectedSteps()
    steps.add(found(motion(), []))
    plan = steps.document(name="p", robot=robot, payload=Payload(1.5, (0.0, 0.0, 0.1)))
    assert "hil_plan" not in plan
    assert plan["loads"][0]["mass_kg"] == 1.5
    notes = steps_of_plan(plan, "plan", (), ("dwell", "move"))
    assert len(notes) == len(steps.steps())
    assert dwell_rule_of(plan, "plan").samples == 10
    assert (notes[3].kind, notes[3].pose, notes[3].payload.mass) == ("dwell", 1, 1.5)
