"""The static separation study on data and parameters that are not as they should be."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from operator import mul
from typing import Any

import numpy as np
import pytest

from hil.core.errors import FitError, SpecError
from hil.data.dataset import Dataset, rows_of
from hil.dynamics import load_model
from hil.studies.base import silent, study
from hil.studies.result import StudyResult
from hil.studies.separation_data import one_per_pose, pairs, recording_of, sample_noise
from hil.studies.tasks import Task, run_tasks
from tests.support.separation_parts import SAMPLES, program, robot

QUICK: dict[str, Any] = {
    "protocols": ["honest"],
    "methods": ["gravity", "coulomb"],
    "folds": 2,
    "figures": False,
    "jobs": 1,
}
PAPER: dict[str, Any] = {
    "protocols": ["paper"],
    "layouts": [[4, 1]],
    "layout": [4, 1],
    "epochs": 1,
    "figures": False,
    "jobs": 1,
}


def studied(data: Dataset, **asked: Any) -> StudyResult:
    return study("static-separation", **{**QUICK, **asked}).run(data, robot())


def warned(found: StudyResult, words: str) -> bool:
    return any(words in warning for warning in found.warnings)


def keys(found: StudyResult) -> set[str]:
    return {table.key for part in found.parts for table in part.tables}


def test_too_few_poses_are_refused() -> None:
    with pytest.raises(FitError, match="3 poses are too few"):
        studied(program(3))


def test_fewer_poses_than_folds_are_refused() -> None:
    with pytest.raises(FitError, match="9 folds are not possible with 6 pose"):
        studied(program(6), folds=9)


def test_poses_too_few_for_every_method_are_refused_with_the_reason() -> None:
    with pytest.raises(FitError, match=r"no method could be fitted.*too few"):
        studied(program(4), methods=["gravity"])


def test_a_paper_protocol_without_enough_poses_leaves_the_honest_one() -> None:
    asked = {**PAPER, "protocols": ["paper", "honest"], "methods": ["coulomb"]}
    found = studied(program(9, noise=1e-3), **asked)
    assert warned(found, "the paper protocol is left out: 6 poses are too few")
    assert "table-honest" in keys(found)


def test_dwells_with_nan_currents_are_left_out_and_told() -> None:
    data = program(30)
    effort = np.array(data["effort"])
    effort[3 * SAMPLES + 4, 2] = np.nan
    found = studied(data.with_columns(effort=effort))
    assert warned(found, "1 dwells hold NaN or infinite positions or efforts and are left out")
    assert np.isfinite([row[-1] for row in found.parts[1].tables[0].rows]).all()


def test_a_recording_of_nothing_but_nan_is_refused() -> None:
    data = program(10)
    with pytest.raises(FitError, match="0 poses are too few"):
        studied(data.with_columns(effort=np.full_like(data["effort"], np.nan)))


def test_dwells_of_fewer_than_ten_samples_are_used_and_told() -> None:
    data = program(30)
    short = rows_of(data, ~((data.series_index() == 5) & (np.arange(len(data)) % 3 == 0)))
    assert warned(studied(short), "1 of 60 dwells have fewer than 10 samples")


def test_dwells_that_never_settled_are_left_out_and_told() -> None:
    data = program(30)
    loose = tuple(replace(c, settled=i > 1) for i, c in enumerate(data.conditions))
    assert warned(studied(replace(data, conditions=loose)), "2 dwells that never came to rest")


def test_a_joint_that_never_moved_is_named() -> None:
    data = program(30)
    q = np.array(data["q"])
    q[:, 5] = 0.3
    found = studied(data.with_columns(q=q))
    assert warned(found, f"{data.joint_names[5]} never moved")


def test_a_still_joint_that_gravity_turns_on_is_refused_with_its_name() -> None:
    data = program(30)
    q = np.array(data["q"])
    q[:, 1] = 0.3
    with pytest.raises(FitError, match=f"(?s){data.joint_names[1]} never moved"):
        studied(data.with_columns(q=q), methods=["ls"])


def test_torques_leave_out_the_paper_and_are_told_in_their_own_unit() -> None:
    data = replace(program(30), effort_kind="torque", drive_gains=None)
    found = studied(data, protocols=["paper", "honest"])
    assert warned(found, "the paper protocol is left out: eq. 16 to 20 are about motor currents")
    assert "N·m" in found.parts[1].tables[0].title


def test_torques_alone_cannot_follow_the_paper() -> None:
    data = replace(program(30), effort_kind="torque", drive_gains=None)
    with pytest.raises(FitError, match="about motor currents"):
        studied(data, protocols=["paper"])


def test_one_sided_approaches_leave_out_the_band() -> None:
    found = studied(program(40, approaches=(1,)), methods=["gravity"])
    assert warned(found, "no pose was approached from both sides")
    assert "table-sides" not in keys(found)


def test_a_method_that_needs_more_than_was_recorded_is_left_out_with_the_reason() -> None:
    found = studied(replace(program(30), arrivals=None))
    assert warned(found, "gravity + Fc·sign(approach) (static-coulomb) is left out")
    assert [row[0] for row in found.parts[1].tables[0].rows][:1] == ["gravity by WLS, shared"]


def test_a_joint_the_robot_does_not_have_is_refused() -> None:
    with pytest.raises(FitError, match="joint is 7, but ur5 has 6"):
        studied(program(10), joint=7)


def test_data_of_another_robot_are_refused() -> None:
    with pytest.raises(FitError, match="recorded on a ur5"):
        study("static-separation", **QUICK).run(program(10), load_model("ur10"))


def test_a_share_of_poses_can_be_held_out_once_instead_of_folds() -> None:
    found = studied(program(30), hold_out_percent=20.0)
    assert "12 dwells of poses drawn at random are held out" in found.parts[1].text[0]


@pytest.mark.thorough
def test_the_paper_protocol_runs_without_the_honest_one() -> None:
    found = studied(program(40), **PAPER)
    assert [part.title for part in found.parts] == ["The recording", "As in the paper"]


def test_poses_of_different_loads_are_not_paired() -> None:
    conditions = program(4).conditions
    loaded = tuple(replace(c, load=int(c.approach > 0)) for c in conditions)
    assert len(pairs(conditions)) == 4
    assert pairs(loaded) == []


def test_noise_of_a_sample_is_the_scatter_within_dwells() -> None:
    dwells = recording_of(program(200, noise=0.02), robot()).dwells
    assert sample_noise(dwells) == pytest.approx(0.02, rel=0.05)
    assert sample_noise(one_per_pose(dwells, 0)) == pytest.approx(0.02, rel=0.05)


@pytest.mark.thorough
def test_results_of_processes_come_in_the_order_of_the_tasks() -> None:
    told: list[tuple[str, int, int]] = []
    tasks = [Task(partial(mul, 2, k), cost=k) for k in range(5)]
    found = run_tasks(tasks, 2, "doubling", lambda *progress: told.append(progress))
    assert found == run_tasks(tasks, 1, "doubling", silent) == [0, 2, 4, 6, 8]
    assert told[0] == ("doubling", 0, 5)
    assert told[-1] == ("doubling", 5, 5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("protocols", "paper"),
        ("protocols", ["published"]),
        ("layouts", []),
        ("layouts", [[5, 10, 1]]),
        ("layout", [4, 10, 2]),
        ("layout", "4-20-1"),
        ("first_layer", "relu"),
        ("epochs", 0),
        ("epochs", 1.5),
        ("alpha", 0),
        ("weights", "ones"),
        ("methods", ["hysterisis"]),
        ("methods", []),
        ("folds", 1),
        ("hold_out_percent", 100),
        ("joint", 0),
        ("figures", "no"),
        ("seed", -1),
        ("jobs", 0),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(SpecError, match=name):
        study("static-separation", **{name: value})
