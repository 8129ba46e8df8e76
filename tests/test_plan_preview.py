"""What `hil plan` shows: the preview's contract and the picture."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from plan_parts import plan_of

from hil.arms.payload import Payload
from hil.excitation.motion import Hold, Line
from hil.planning.plan import DwellRule, LoadStep, Plan, Step
from hil.planning.plan_preview import preview
from hil.recording.mcap_writer import McapWriter
from hil.report.plan_figure import plan_picture
from hil.report.svg import Scale, thinned
from hil.robot.state import state_topic

pytestmark = pytest.mark.quick

NAMES = tuple(f"shoulder_{i}_joint" for i in range(6))
SVG = "{http://www.w3.org/2000/svg}"


@cache
def dwell_plan() -> Plan:
    return plan_of(reference={"every": 3})


@cache
def fourier_plan() -> Plan:
    return plan_of(excitation={"kind": "fourier", "trajectories": 2})


def test_the_preview_keeps_its_keys() -> None:
    shown = preview(dwell_plan()).to_dict()
    contract = (
        "waypoints", "duration_s", "recording_bytes", "margins", "condition_number", "hash",
    )  # fmt: skip
    assert set(contract) <= set(shown)
    assert shown["waypoints"] == 6
    assert shown["hash"] == dwell_plan().hash
    assert (shown["steps"]["dwell"], shown["steps"]["reference"]) == (12, 6)
    assert sum(shown["steps"].values()) == len(dwell_plan())
    assert {"position_rad", "velocity_rad_s", "acceleration_rad_s2", "clearance_m"} <= set(
        shown["margins"]
    )


def test_the_duration_is_motions_and_dwells() -> None:
    line = Line((0.0,) * 6, (0.5,) * 6, 1.0, 2.0, 20.0, 125.0)
    steps = (Step(0, "payload"), Step(1, "move", line), Step(2, "dwell", Hold(line.goal), pose=0))
    plan = Plan("p", "ur5", NAMES, 125.0, steps, (LoadStep(Payload()),), DwellRule(dwell_s=1.0))
    assert 1.0 < plan.duration_s - line.duration_s < 1.5
    assert preview(plan).samples == round(plan.duration_s * 125.0)


def test_the_recording_takes_about_as_much_as_estimated(tmp_path: Path) -> None:
    plan = dwell_plan()
    topic = state_topic(6, plan.rate_hz, clock="virtual", effort_unit="A")
    samples = [motion.sample(plan.rate_hz) for motion in plan.motions if motion.duration_s > 0]
    q, qd, qdd = (
        np.concatenate([getattr(s, name) for s in samples]) for name in ("q", "qd", "qdd")
    )
    noise = np.random.default_rng(0).standard_normal((3, *q.shape))
    rows = topic.blank(len(q))
    rows["device_time"] = np.arange(len(q)) / plan.rate_hz
    rows["host_time"] = 1.8e9 + rows["device_time"]
    rows["q_target"], rows["qd_target"], rows["qdd_target"] = q, qd, qdd
    rows["q"], rows["qd"] = q + 2e-5 * noise[0], qd + 2e-3 * noise[1]
    rows["effort_target"], rows["temperature"] = np.sin(q), 30.0
    rows["effort"] = np.sin(q) + 0.05 * noise[2]
    with McapWriter(tmp_path / "00.mcap", [topic], joint_names=plan.joint_names) as writer:
        writer.write(topic.name, rows)
    measured = (tmp_path / "00.mcap").stat().st_size / len(rows)
    estimated = preview(plan).recording_bytes / preview(plan).samples
    assert estimated == pytest.approx(measured, rel=0.25)


def elements(path: Path, tag: str, kind: str) -> list[ET.Element]:
    root = ET.parse(path).getroot()
    return [e for e in root.iter(SVG + tag) if kind in e.get("class", "").split()]


@pytest.mark.parametrize("plan_of_kind", [dwell_plan, fourier_plan])
def test_the_picture_is_one_self_contained_svg(plan_of_kind: object, tmp_path: Path) -> None:
    plan = plan_of_kind()  # type: ignore[operator]
    path = plan_picture(plan, tmp_path / "plan.svg")
    written = path.read_text("utf-8")
    assert ET.fromstring(written).tag == SVG + "svg"
    without_namespace = written.replace("http://www.w3.org/2000/svg", "")
    assert not any(word in without_namespace for word in ("http", "href", "url(", "<script"))
    assert "prefers-color-scheme: dark" in written
    assert plan.hash[:12] in written


def test_the_picture_marks_every_dwell_of_every_joint(tmp_path: Path) -> None:
    marks = elements(plan_picture(dwell_plan(), tmp_path / "plan.svg"), "path", "mark")
    assert len(marks) == 6
    assert [mark.get("d", "").count("M") for mark in marks] == [12 + 6] * 6


def test_the_picture_shows_where_the_flange_is_measured(tmp_path: Path) -> None:
    above, side = elements(plan_picture(dwell_plan(), tmp_path / "plan.svg"), "path", "place")
    # Six poses; the reference is the first of them.
    assert above.get("d", "").count("M") == side.get("d", "").count("M") == 6


def test_the_picture_names_joints_and_limits(tmp_path: Path) -> None:
    written = plan_picture(fourier_plan(), tmp_path / "plan.svg").read_text("utf-8")
    for words in ("1 shoulder pan", "6 wrist 3", "limit: 100 °/s, 300 °/s²", "2 trajectories"):
        assert words in written


def test_thinning_keeps_the_extremes() -> None:
    t = np.linspace(0, 1, 10_000)
    y = np.sin(40 * t)
    y[1234] = 3.0
    few_t, few = thinned(t, y, 100)
    assert len(few_t) == len(few) <= 200
    assert few.max() == 3.0
    assert few.min() == y.min()


@pytest.mark.parametrize(("low", "high"), [(0, 67.3), (-180, 180), (-0.97, 0.97), (65, 105)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    ticks = Scale(low, high, 0, 100).ticks(6)
    assert 2 <= len(ticks) <= 13
    assert low <= ticks[0] <= ticks[-1] <= high
    assert all(len(f"{tick:g}") <= 5 for tick in ticks)
