"""What the weeks of a simulation show: each thing that is not as it should be is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hil.report.simulation_page import found

JOINTS = ["a", "b"]


def occasion(
    week: int, outcome: str = "quiet", *, changed: bool = False, before: Any = (1.0, 2.0),
    after: Any = None, champion: str = "v1", was: str | None = "v1",
) -> dict[str, Any]:  # fmt: skip
    errors = {"joint_names": JOINTS, "before": list(before), "after": list(after or before)}
    drift = {"changed": changed, "text": "friction up on b" if changed else "nothing has changed"}
    result = {
        "outcome": outcome, "text": outcome, "champion": champion, "before": was,
        "errors": errors if was else None, "drift": drift if was else None,
    }  # fmt: skip
    return {"week": float(week), "event": "done", "why": "", "result": result}


FIRST = occasion(0, "promoted", was=None)
SEEN = occasion(3, "promoted", changed=True, before=(1.0, 4.0), after=(1.0, 2.1), champion="v2")
GOOD = [FIRST, occasion(1), occasion(2), SEEN, occasion(4, champion="v2", was="v2")]


def told(occasions: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "wear_weeks": [2.5],
        "simulate": {"wear": [{"factors": [1, 1.15]}]},
        "occasions": occasions,
    }


def missed(*occasions: dict[str, Any]) -> list[str]:
    """Criteria that are missed when some weeks are others."""
    weeks = {each["week"]: each for each in (*GOOD, *occasions)}
    criteria = found(told([weeks[week] for week in sorted(weeks)])).criteria
    return [one.asked for one in criteria if not one.met]


def test_when_all_is_as_it_should_be_it_is_said() -> None:
    what = found(told(GOOD))
    assert all(one.met for one in what.criteria)
    assert what.promoted == (0.0, 3.0)
    assert what.weeks == (1.0, 2.0, 3.0, 3.0, 4.0)
    assert np.array_equal(what.level, [1.0, 2.0])
    assert what.after.tolist() == pytest.approx([1.0, (1.05 + 1.0) / 2])
    assert what.sentences == (
        "4 probes; after 17.5 days friction is 1.15 times as much on J2.",
        "Week 3: friction up on b; v2 is promoted.",
        "Since then the mean error is 101 % of the first probe's, that of J2 102 %.",
    )


def test_wear_after_the_end_is_not_called_a_change() -> None:
    what = found({**told(GOOD[:3]), "weeks": 2.0})
    assert what.sentences[0] == "2 probes; wear of day 17.5 is beyond these 2 weeks: not shown."


def test_a_change_that_is_seen_later_was_not_seen_by_the_first_probe_after_it() -> None:
    late = occasion(4, "promoted", changed=True, champion="v2")
    asked = missed(occasion(3), late)
    assert asked[0].startswith("the change after 17.5 days is seen by the first probe")
    assert asked[1].startswith("the robot is identified again")
    assert "nothing is promoted without a change" in asked


def test_a_challenger_that_is_kept_out_leaves_the_error() -> None:
    kept = occasion(3, "kept", changed=True, before=(1.0, 4.0))
    assert [one.split(",")[0] for one in missed(kept)] == [
        "the robot is identified again", "the error is back at that of the first probe",
        "so is that of J2 by itself",
    ]  # fmt: skip


def test_a_promotion_and_an_alarm_without_a_change_are_told() -> None:
    assert missed(occasion(2, "promoted", changed=True)) == [
        "nothing is promoted without a change",
        "no probe without a change calls the robot changed",
    ]


def test_an_error_that_stays_is_told() -> None:
    worse = occasion(4, champion="v2", was="v2", before=(1.4, 2.0))
    assert missed(worse) == ["the error is back at that of the first probe, within 10 %"]


def test_the_joint_that_wore_is_not_lost_in_the_mean() -> None:
    worse = [
        {**week, "result": week["result"] | {"errors": errors}}
        for week, errors in (
            (SEEN, {"joint_names": JOINTS, "before": [0.6, 4.0], "after": [0.6, 2.6]}),
            (GOOD[4], {"joint_names": JOINTS, "before": [0.6, 2.6], "after": [0.6, 2.6]}),
        )
    ]
    assert missed(*worse) == [
        "so is that of J2 by itself, within 10 % beyond the wear: at most 126.5 % of its own"
    ]


def test_without_probes_there_are_no_errors_to_compare() -> None:
    weeks = [FIRST, {**SEEN, "result": SEEN["result"] | {"errors": None, "drift": None}}]
    what = found({**told(weeks), "wear_weeks": [], "simulate": {"wear": []}})
    assert what.weeks == ()
    assert what.after.size == 0
    assert what.sentences == ("0 probes; no wear.",)


def test_occasions_that_failed_have_no_numbers() -> None:
    failed = {"week": 3.0, "event": "failed", "why": "the robot is gone", "result": None}
    what = found(told([*GOOD[:3], failed]))
    assert [one.found for one in what.criteria[:2]] == [
        "week 3: the robot is gone",
        "the robot is gone",
    ]
    assert what.share_of(failed) == "–"
    assert what.share_of(GOOD[1]) == "100"
