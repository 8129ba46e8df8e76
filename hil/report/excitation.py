"""The section about the motion: joint angles, pose map, position–velocity coverage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Dataset
from hil.report import plotly_figures as figures
from hil.report.blocks import Block, Facts, Panel, Plots, Section, items
from hil.report.documents import as_float, as_index, as_object
from hil.report.facts import RunFacts
from hil.report.recording import Recording, dwell_poses, rows_of_steps
from hil.report.words import joint_title, number, with_unit_apart

DEGREES = 180 / np.pi
COVERAGE_ROWS = 60_000
"""Rows the coverage is counted on, evenly spread over the recording."""


def excitation(
    facts: RunFacts, recording: Recording, names: Sequence[str], held_out: Sequence[Dataset]
) -> Section:
    """Where the arm went, from the recorded positions.

    Args:
        facts: Small files of the run.
        recording: Its samples.
        names: Joint names, length n.
        held_out: The series each model was judged on, to mark their poses.
    """
    blocks: list[Block] = [_plan(facts), _angles(recording, names)]
    poses, where = dwell_poses(facts, recording)
    if len(poses) and len(names) > 1:
        blocks.append(_pose_map(facts, poses, where, names, held_out))
    blocks.append(_coverage(facts, recording, names))
    lead = "Where the arm went, from the recorded positions."
    return Section("excitation", "Excitation", lead, tuple(blocks))


def _plan(facts: RunFacts) -> Facts:
    kinds = [str(step.get("kind")) for step in facts.steps]
    poses = {as_index(step.get("pose")) for step in facts.steps if step.get("kind") == "dwell"}
    said: dict[str, object] = {
        "steps": f"{facts.steps_done} of {len(kinds)} done" if kinds else None,
        "poses": len(poses) or None,
        "dwells": kinds.count("dwell") or None,
        "trajectories": kinds.count("trajectory") or None,
        "reference visits": kinds.count("reference") or None,
    }
    condition = as_float(facts.plan.get("condition_number"))
    if np.isfinite(condition):
        said["condition number of the regressor"] = number(condition)
    for name, value in as_object(facts.plan.get("margins")).items():
        said[f"margin: {with_unit_apart(name)}"] = number(as_float(value))
    return Facts("Plan", items(said))


def _angles(recording: Recording, names: Sequence[str]) -> Plots:
    q: FloatArray = recording.rows["q"] * DEGREES
    panels = tuple(
        Panel(
            joint_title(j, name),
            figures.over_time(recording.t, q[:, j], "position [°]", j, recording.begins),
            f"Position of {name} over time, {q[:, j].min():.0f}° to {q[:, j].max():.0f}°.",
        )
        for j, name in enumerate(names)
    )
    return Plots("Joint angles over time", "", panels)


def _pose_map(
    facts: RunFacts,
    poses: IntArray,
    where: FloatArray,
    names: Sequence[str],
    held_out: Sequence[Dataset],
) -> Plots:
    unsettled = np.isin(poses, facts.unsettled)
    kept_away = {c.pose for data in held_out for c in data.conditions if c.kind == "dwell"}
    held = np.isin(poses, list(kept_away)) & ~unsettled
    groups = {
        "trained on" if facts.judged_fits else "measured": np.flatnonzero(~held & ~unsettled),
        "held out": np.flatnonzero(held),
        "not settled": np.flatnonzero(unsettled),
    }
    pairs = [(j, min(j + 1, len(names) - 1)) for j in range(0, len(names), 2)]
    panels = tuple(
        Panel(
            f"J{a + 1} and J{b + 1}",
            figures.pose_map(
                where[:, a] * DEGREES,
                where[:, b] * DEGREES,
                groups,
                f"J{a + 1} position [°]",
                f"J{b + 1} position [°]",
            ),
            f"{len(poses)} poses along {names[a]} and {names[b]}.",
        )
        for a, b in pairs
    )
    looks = zip(groups, figures.POSE_LOOKS, ("●", "◇", "✕"), strict=False)
    legend = tuple((name, look[0], sign) for name, look, sign in looks if len(groups[name]))
    return Plots("Pose map", f"The {len(poses)} poses the arm stood still at.", panels, legend)


def _coverage(facts: RunFacts, recording: Recording, names: Sequence[str]) -> Plots:
    trajectories = facts.indices("trajectory")
    chosen = rows_of_steps(recording.rows, trajectories)
    rows = chosen if len(chosen) else recording.rows
    rows = rows[:: max(1, len(rows) // COVERAGE_ROWS)]
    q, qd = rows["q"] * DEGREES, rows["qd"] * DEGREES
    panels = tuple(
        Panel(
            joint_title(j, name),
            figures.coverage(q[:, j], qd[:, j], "position [°]", "velocity [°/s]"),
            f"Position–velocity coverage of {name}, up to {np.abs(qd[:, j]).max():.0f} °/s.",
        )
        for j, name in enumerate(names)
    )
    when = "on the trajectories" if len(chosen) else "in the whole run"
    lead = f"How often each position and velocity occurred {when}: the stronger, the more often."
    return Plots("Position and velocity coverage", lead, panels)
