"""Trajectories that took long are computed once, and nothing that is damaged is driven."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import PlanError
from hil.excitation.cache import user_cache
from tests.support.excitation_parts import Bench, Finder, bench, finder  # noqa: F401


def test_asking_again_computes_nothing(bench: Bench) -> None:  # noqa: F811
    before = bench.trajectories(2)
    assert bench.trajectories(2) == before
    assert bench.computed == 0


def test_asking_for_fewer_gives_the_first_ones(bench: Bench) -> None:  # noqa: F811
    before = bench.trajectories(3)
    assert bench.trajectories(1) == before[:1]
    assert len(bench.trajectories(3)) == 3
    assert bench.computed == 0


def test_asking_for_more_computes_only_the_new_ones(bench: Bench) -> None:  # noqa: F811
    before = bench.trajectories(2)
    assert bench.trajectories(3)[:2] == before
    assert bench.computed == 1


def test_a_later_trajectory_knows_of_those_from_the_cache(bench: Bench) -> None:  # noqa: F811
    bench.trajectories(2)
    bench.trajectories(3)
    (problem,) = bench.finder.problems
    assert problem.earlier is not None
    assert problem.earlier.shape[1] == problem.regressor(bench.trajectories(1)[0]).shape[1]


def test_what_was_found_before_an_interruption_is_not_lost(
    bench: Bench,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(problem: Any, **asked: Any) -> Any:
        if problem.earlier is not None:
            raise KeyboardInterrupt
        return bench.finder(problem, **asked)

    with monkeypatch.context() as patched:
        patched.setattr("hil.excitation.fourier.optimise", interrupted)
        with pytest.raises(KeyboardInterrupt):
            bench.trajectories(2)
    bench.trajectories(2)
    assert bench.computed == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"periods": 1', '"periods": 2'),
        lambda text: text.replace('"key": "', '"key": "0'),
        lambda text: "[]",
    ],
    ids=["torn", "changed", "of another question", "something else"],
)
def test_a_damaged_entry_is_told_and_computed_again(
    bench: Bench,  # noqa: F811
    damage: Callable[[str], str],
) -> None:
    before = bench.trajectories()
    bench.entry.write_text(damage(bench.entry.read_text()))
    assert bench.trajectories() == before
    assert bench.computed == 1
    assert "damaged" in bench.notes[0]
    assert json.loads(bench.entry.read_text())["trajectories"] == [before[0].to_dict()]


def test_fresh_computes_what_the_cache_has(bench: Bench) -> None:  # noqa: F811
    bench.trajectories()
    bench.trajectories(fresh=True)
    assert bench.computed == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 8}, {"objective": "condition"}, {"scaled": False}, {"clearance_mm": 25},
        {"torque_percent": 70}, {"friction": True}, {"rotor": False}, {"starts": 4},
        {"max_jerk_deg_s3": 900}, {"budget_s": 1},
    ],
    ids=lambda changes: next(iter(changes)),
)  # fmt: skip
def test_another_question_has_another_entry(bench: Bench, changes: dict[str, Any]) -> None:  # noqa: F811
    assert bench.key(**changes) != bench.key()


def test_how_many_are_asked_for_is_no_part_of_the_question(bench: Bench) -> None:  # noqa: F811
    assert bench.key(5) == bench.key(2)


def test_a_folder_that_cannot_be_written_to_is_told_and_no_obstacle(
    tmp_path: Path,
    finder: Finder,  # noqa: F811
) -> None:
    (tmp_path / "file").write_text("")
    bench = Bench(tmp_path / "file" / "cache", finder)  # noqa: F811
    assert len(bench.trajectories()) == 1
    assert "cannot make" in bench.notes[0]


def test_less_clearance_than_the_station_asks_for_is_refused(bench: Bench) -> None:  # noqa: F811
    with pytest.raises(PlanError, match=r"clearance_mm: 5 mm is less than the 20 mm"):
        bench.trajectories(clearance_mm=5)


def test_the_heaviest_load_is_what_torques_are_limited_for(bench: Bench) -> None:  # noqa: F811
    bench.trajectories(torque_percent=50)
    (problem,) = bench.finder.problems
    assert [load.mass for load in problem.robot.payloads] == [2.0]
    assert problem.limit("effort_max").tolist() == [75.0] * 6


def test_the_cache_is_where_the_environment_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIL_CACHE", str(tmp_path))
    assert user_cache().folder == tmp_path / "excitation"
    monkeypatch.setenv("HIL_CACHE", "off")
    assert user_cache().folder is None
    monkeypatch.delenv("HIL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setattr("sys.platform", "linux")
    assert user_cache().folder == tmp_path / "xdg" / "hil" / "excitation"
