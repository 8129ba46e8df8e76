"""Run directories for the report tests, written through the real recorder, plan and run API.

The effort is made up (gravity-like sines, friction by direction, seeded noise): reports are tested
here, not identification.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.excitation.motion import FourierSeries, Hold, Line
from hil.planning.plan import LoadStep, Plan, Step
from hil.recording import McapWriter, RunDirectory, collect_provenance
from hil.robot import Status, state_dtype
from hil.robot.state import STATE_TOPIC, state_topic

RATE = 125.0
NOISE = 0.02
JOINTS = load_arm("ur5").joint_names
SPEC = """\
hil: 1
name: {name}
robot: ur5
excitation: {excitation}
reference: {{every: 5}}
interlocks: [{{kind: tracking_error, limit_rad: 0.05}}, {{kind: temperature, limit_c: 70}}]
fit: [{{estimator: {estimator}}}]
validate: {{hold_out: {hold_out}}}
accept: {accept}
"""


def dwell_plan(name: str = "dwells", poses: int = 24) -> Plan:
    """Every pose from below and from above, a visit to the reference pose after every fifth."""
    rng = np.random.default_rng(3)
    arm = load_arm("ur5")
    where = rng.uniform(arm.excite_min, arm.excite_max, (poses, 6)) * 0.8
    steps: list[Step] = []

    def stay(kind: Any, q: Any, approach: int, pose: int) -> None:
        goal = tuple(float(v) for v in q)
        steps.append(Step(len(steps), "move", Hold(goal), checkpoint=True))
        steps.append(Step(len(steps), kind, Hold(goal), pose=pose, approach=approach))

    for pose, q in enumerate(where):
        if pose % 5 == 0:
            stay("reference", where[0], 1, -1)
            stay("reference", where[0], -1, -1)
        for approach in (1, -1):
            stay("dwell", q, approach, pose)
    return Plan(
        name,
        "ur5",
        JOINTS,
        RATE,
        tuple(steps),
        (LoadStep(Payload()),),
        margins={"position_rad": 0.5},
    )


def fourier_plan(name: str = "fourier", trajectories: int = 3) -> Plan:
    """Trajectories of 8 s at rest at both ends, joined by moves."""
    steps: list[Step] = []
    rng = np.random.default_rng(5)
    before = (0.0, -1.5, 1.0, -1.0, 0.5, 0.0)
    for number in range(trajectories):
        a = rng.uniform(-0.5, 0.5, (6, 5))
        b = rng.uniform(-0.5, 0.5, (6, 5))
        a[:, -1] = -a[:, :-1].sum(axis=1)
        b[:, -1] = -(b[:, :-1] * np.arange(1, 5)).sum(axis=1) / 5
        motion = FourierSeries(before, _rows(a), _rows(b), 0.125)
        start = tuple(float(v) for v in motion.q_start)
        steps.append(Step(len(steps), "move", Line(before, start, 1.0, 2.0, 20.0, RATE)))
        steps.append(Step(len(steps), "trajectory", motion, trajectory=number))
    return Plan(name, "ur5", JOINTS, RATE, tuple(steps), (LoadStep(Payload()),))


def rows_of_plan(plan: Plan, dwell_rows: int = 14) -> np.ndarray:
    """What a robot that follows exactly would record."""
    parts = [part for step in plan for part in _rows_of_step(step, dwell_rows)]
    rows = np.zeros(sum(len(q) for _, q, _ in parts), state_dtype(6))
    rows["q_target"] = np.concatenate([q for _, q, _ in parts])
    rows["qd"] = np.concatenate([qd for _, _, qd in parts])
    rows["segment"] = np.concatenate([np.full(len(q), step.index) for step, q, _ in parts])
    sign = np.concatenate([np.full(len(q), step.approach) for step, q, _ in parts])
    rng = np.random.default_rng(1)
    rows["q"] = rows["q_target"] + 1e-4 * rng.standard_normal(rows["q"].shape)
    friction = 0.2 * np.tanh(rows["qd"] / 0.05) + 0.1 * sign[:, None]
    gravity = np.sin(rows["q"]) + 0.5 * np.cos(rows["q"].cumsum(axis=1))
    rows["effort"] = gravity + friction + NOISE * rng.standard_normal(rows["q"].shape)
    rows["device_time"] = np.arange(1, len(rows) + 1) / RATE
    rows["host_time"] = 1.8e9 + rows["device_time"]
    rows["temperature"] = 25 + 5 * rows["device_time"][:, None] / rows["device_time"][-1]
    rows["status"] = Status.HOLDING
    return rows


def write_run(
    root: Path,
    plan: Plan,
    *,
    name: str | None = None,
    outcome: str | None = "completed",
    reason: str = "",
    rows: np.ndarray | None = None,
    accept: str = "{}",
    robot: dict[str, Any] | None = None,
    finish: bool = True,
) -> RunDirectory:
    """A run directory as the campaign leaves it; `outcome` None leaves stop.json out."""
    run = RunDirectory.create(root, "ur5", "report")
    dwells = any(step.kind == "dwell" for step in plan)
    run.write_text(
        "spec.yaml",
        SPEC.format(
            name=name or plan.name,
            excitation="{kind: dwell, waypoints: 24}" if dwells else "{kind: fourier}",
            estimator="static-wls" if dwells else "rigid-wls",
            hold_out="{poses_percent: 25}" if dwells else "{trajectories: 1}",
            accept=accept,
        ),
    )
    run.write_json("plan.json", plan.to_dict())
    run.write_start(
        collect_provenance() | {"plan_hash": plan.hash, "robot": robot or robot_facts()}
    )
    with run.event_log() as log:
        log.append("state", state="running")
        log.append("checkpoint", step=2)
    written = rows_of_plan(plan) if rows is None else rows
    _record(run, written, finish)
    if outcome is not None:
        document = {
            "samples": len(written),
            "gaps": 0,
            "missing": 0,
            "duplicates": 0,
            "overruns": 0,
        }
        steps = int(written["segment"].max(initial=0)) + 1
        more = {
            "steps_done": steps,
            "unsettled": [],
            "device_s": len(written) / RATE,
            "wall_s": 2.0,
        }
        run.write_stop(outcome, reason, document | more | {"problems": []})  # type: ignore[arg-type]
    return run


def robot_facts() -> dict[str, Any]:
    """What `start.json` says about the robot."""
    return {
        "model": "ur5",
        "identity": {
            "model": "ur5",
            "serial": "S-1",
            "firmware": "1",
            "driver": "test",
            "details": {},
        },
        "joint_names": list(JOINTS),
        "rate_hz": RATE,
        "clock": "virtual",
        "effort_kind": "current",
        "drive_gains": [10.0] * 6,
        "drive_gains_source": "made up",
    }


def _record(run: RunDirectory, rows: np.ndarray, finish: bool) -> None:
    topic = state_topic(6, RATE, clock="virtual", effort_unit="A")
    writer = McapWriter(run.part_path(len(run.recordings)), [topic])
    if len(rows):
        writer.write(STATE_TOPIC, rows)
    writer.flush(durable=False)
    writer.finish() if finish else writer.abandon()


def _rows_of_step(step: Step, dwell_rows: int) -> Iterator[tuple[Step, Any, Any]]:
    assert step.motion is not None
    if isinstance(step.motion, Hold):
        q = np.tile(step.motion.q_end, (dwell_rows, 1))
        yield step, q, np.zeros_like(q)
    else:
        samples = step.motion.sample(RATE)
        yield step, samples.q, samples.qd


def _rows(values: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in values)
