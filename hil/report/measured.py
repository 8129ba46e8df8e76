"""The measuring series of a run as a dataset, cut from rows that have been read already.

`hil.importers.load.load_source` gives the same series and all moves between them. For a long dwell
program the moves are nearly all rows, and reading and assembling them again would take longer than
the rest of the report.
"""

from __future__ import annotations

from hil.core import DataError
from hil.data import Dataset, SeriesKind
from hil.importers import Origin, Series, assemble, cut, dwell_rule_of, origin_of_run, steps_of_plan
from hil.report.facts import RunFacts
from hil.report.recording import Recording

MEASURED: tuple[SeriesKind, ...] = ("dwell", "trajectory")


def measured(facts: RunFacts, recording: Recording) -> Dataset:
    """The dwells and trajectories of a run.

    Raises:
        DataError: There are none, or the run does not describe its robot.
    """
    notes = steps_of_plan(facts.plan, facts.path / "plan.json", facts.unsettled_steps, MEASURED)
    latest: dict[int, list[Series]] = {}
    for attempt, rows in enumerate(recording.attempts):
        pieces = cut(rows, notes, attempt)
        # A later attempt replaces what an earlier one recorded of the same step.
        latest |= {piece.step: [] for piece in pieces}
        for piece in pieces:
            latest[piece.step].append(piece)
    series = [piece for step in sorted(latest) for piece in latest[step]]
    rule = dwell_rule_of(facts.plan, facts.path / "plan.json")
    return assemble(series, _origin(facts), rule.samples)


def _origin(facts: RunFacts) -> Origin:
    robot = facts.robot
    if not robot.get("model") or not facts.joint_names:
        raise DataError(
            f"{facts.path / 'start.json'} does not describe the robot",
            hint="the run directory is damaged or was edited: take it from a copy",
        )
    described = {"joint_names": list(facts.joint_names), "effort_kind": _effort_kind(facts)}
    return origin_of_run({"robot": {**robot, **described}}, str(facts.path))


def _effort_kind(facts: RunFacts) -> str:
    return "torque" if facts.effort_unit == "N·m" else "current"
