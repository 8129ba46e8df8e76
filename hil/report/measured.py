"""The measuring series of a run as a dataset, cut from rows that have been read already.

`hil.data.load.load_source` gives the same series and all moves between them. For a long dwell
program the moves are nearly all rows, and reading and assembling them again would take longer than
the rest of the report.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.data.dataset import Dataset
from hil.data.series import Origin, Series, StepNote, assemble, cut
from hil.errors import DataError
from hil.payload import Payload
from hil.report.documents import Document, as_float, as_object, as_objects
from hil.report.facts import RunFacts
from hil.report.recording import Recording

MEASURED = ("dwell", "trajectory")


def measured(facts: RunFacts, recording: Recording) -> Dataset:
    """The dwells and trajectories of a run.

    Raises:
        DataError: There are none, or the run does not describe its robot.
    """
    steps = facts.indices(*MEASURED)
    loads, unsettled = as_objects(facts.plan.get("loads")), facts.unsettled_steps
    notes = {i: _note(facts.steps[i], loads, settled=i not in unsettled) for i in steps}
    latest: dict[int, list[Series]] = {}
    for attempt, rows in enumerate(recording.attempts):
        pieces = cut(rows, notes, attempt)
        # A later attempt replaces what an earlier one recorded of the same step.
        latest |= {piece.step: [] for piece in pieces}
        for piece in pieces:
            latest[piece.step].append(piece)
    series = [piece for step in sorted(latest) for piece in latest[step]]
    samples = as_float(as_object(facts.plan.get("dwell")).get("samples"))
    return assemble(series, _origin(facts), int(samples) if np.isfinite(samples) else 10)


def _note(step: Document, loads: Sequence[Document], *, settled: bool) -> StepNote:
    load = int(step.get("load", 0))
    return StepNote(
        kind=step["kind"],
        trajectory=int(step.get("trajectory", -1)),
        pose=int(step.get("pose", -1)),
        approach=int(step.get("approach", 0)),
        load=load,
        payload=_payload(loads[load] if load < len(loads) else {}),
        settled=settled,
    )


def _payload(raw: Document) -> Payload:
    return Payload(
        float(raw.get("mass_kg", 0.0)),
        tuple(raw.get("com_m", (0.0,) * 3)),
        tuple(raw.get("inertia_kgm2", (0.0,) * 6)),
    )


def _origin(facts: RunFacts) -> Origin:
    robot, gains = facts.robot, facts.robot.get("drive_gains")
    if not robot.get("model") or not facts.joint_names:
        raise DataError(f"{facts.path / 'start.json'} does not describe the robot")
    return Origin(
        source=str(facts.path),
        robot=str(robot["model"]),
        joint_names=facts.joint_names,
        effort_kind="torque" if facts.effort_unit == "N·m" else "current",
        drive_gains=np.array(gains, dtype=np.float64) if gains else None,
        drive_gains_source=str(robot.get("drive_gains_source") or ""),
    )
