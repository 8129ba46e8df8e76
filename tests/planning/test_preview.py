"""What `hil plan` shows: the preview, its warnings, and what the motion sweeps."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.dynamics import load_model
from hil.dynamics.build import model_from_arm
from hil.excitation.motion import Hold, Line
from hil.planning.plan import DwellRule, LoadStep, Plan, Step
from hil.planning.plan_preview import concerns, preview
from hil.planning.swept_space import elbow_bodies, swept
from hil.recording.mcap_writer import McapWriter
from hil.report.plan_drawing import (
    close_up,
    overview,
    peaks_and_places,
    plan_picture,
    timeline_of,
)
from hil.robot.state import state_topic
from tests.support.plan_parts import plan_of

# What `hil plan` shows: the preview's contract and the picture


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


@pytest.mark.thorough
@pytest.mark.parametrize("plan_of_kind", [dwell_plan, fourier_plan])
def test_the_picture_is_one_self_contained_svg(plan_of_kind: object, tmp_path: Path) -> None:
    plan = plan_of_kind()  # type: ignore[operator]
    path = plan_picture(plan, tmp_path / "plan.svg")
    written = path.read_text("utf-8")
    assert ET.fromstring(written).tag == SVG + "svg"
    inside = re.sub(r'(href="|url\()#|xmlns(:xlink)?="[^"]*"', "", written)
    assert not any(word in inside for word in ("http", "href", "url(", "<script"))
    assert "prefers-color-scheme: dark" in written
    assert plan.hash[:12] in written


def test_the_picture_marks_every_dwell_of_every_joint() -> None:
    figure = overview(dwell_plan(), timeline_of(dwell_plan()))
    assert len(figure.panels) == 6
    assert [len(panel.curves[-1].y) for panel in figure.panels] == [12 + 6] * 6


def test_the_picture_shows_where_the_flange_is_measured() -> None:
    _, above, side = peaks_and_places(dwell_plan(), timeline_of(dwell_plan())).panels
    # Six poses; the reference is the first of them.
    assert len(above.curves[0].x) == len(side.curves[0].x) == 6


def test_the_picture_shades_every_dwell_it_looks_closer_at() -> None:
    (panel,) = close_up(dwell_plan(), timeline_of(dwell_plan())).panels
    assert {span.approach for span in panel.spans} == {1, -1}
    assert len(panel.curves) == 6


@pytest.mark.thorough
def test_the_picture_names_joints_and_limits(tmp_path: Path) -> None:
    written = plan_picture(fourier_plan(), tmp_path / "plan.svg").read_text("utf-8")
    for words in ("1 shoulder pan", "6 wrist 3", "limit: 100 °/s, 300 °/s²", "2 trajectories"):
        assert words in written


@pytest.mark.thorough
def test_colours_of_the_picture_follow_the_screen(tmp_path: Path) -> None:
    written = plan_picture(fourier_plan(), tmp_path / "plan.svg").read_text("utf-8")
    fixed = set(re.findall(r"(?:fill|stroke): (#[0-9a-f]{6})", written)) - {"#ffffff"}
    assert fixed == set()
    assert "#4da3f7" in written, "the measured colour on a dark screen"


# What `hil plan` warns of, and what it does not


def test_an_ordinary_plan_raises_no_concern() -> None:
    assert list(concerns(20.0, 3600.0, 1e8)) == []


@pytest.mark.parametrize(
    ("condition", "duration_s", "size", "word"),
    [
        (1001.0, 1.0, 1.0, "the condition number is 1001, above 1000"),
        (math.inf, 1.0, 1.0, "infinite condition number"),
        (2.0, 12.5 * 3600, 1.0, "12.5 h, more than 12 h"),
        (2.0, 1.0, 21e9, "21 GB, more than 20 GB"),
    ],
)
def test_each_concern_is_told_with_its_figure(
    condition: float, duration_s: float, size: float, word: str
) -> None:
    (told,) = concerns(condition, duration_s, size)
    assert word in told


# What a plan sweeps: time, joint ranges, and the boxes of tool and elbow


RATE_HZ = 125.0
HERE = (0.0, -1.2, 1.0, -1.5, 0.2, 0.0)
THERE = (1.0, -0.7, -0.6, -1.0, -0.4, 2.0)


def plan_to(arm="ur5", *, size_m=None, goal=THERE):
    way = Line(HERE, goal, 1.0, 2.0, 20.0, RATE_HZ)
    steps = (Step(0, "payload"), Step(1, "move", way), Step(2, "dwell", Hold(goal), pose=0))
    names = load_arm(arm).joint_names
    return Plan("p", arm, names, RATE_HZ, steps, (LoadStep(Payload(), size_m=size_m),))


def positions(plan):
    return np.vstack([np.array(HERE), plan.motions[0].sample(RATE_HZ).q])


def test_joint_ranges_reach_from_where_the_arm_stands_to_the_furthest_set_point():
    space = swept(plan_to(), load_arm("ur5"))
    assert space.q_min == pytest.approx(np.minimum(HERE, THERE))
    assert space.q_max == pytest.approx(np.maximum(HERE, THERE))


def test_the_duration_is_that_of_the_plan():
    plan = plan_to()
    assert swept(plan, load_arm("ur5")).duration_s == plan.duration_s


def test_the_tool_box_is_that_of_the_flange_at_every_set_point():
    plan = plan_to()
    places = load_model("ur5").flange_pose(positions(plan))[:, :3, 3]
    box = swept(plan, load_arm("ur5")).tool
    assert box.low == pytest.approx(places.min(axis=0), abs=1e-9)
    assert box.high == pytest.approx(places.max(axis=0), abs=1e-9)


def test_the_tool_box_includes_a_load_of_known_size():
    length_m, radius_m = 0.3, 0.05
    plan = plan_to(size_m=(length_m, radius_m))
    poses = load_model("ur5").flange_pose(positions(plan))
    places = np.vstack([poses[:, :3, 3], poses[:, :3, 3] + length_m * poses[:, :3, 2]])
    space = swept(plan, load_arm("ur5"))
    assert space.tool.low == pytest.approx(places.min(axis=0) - radius_m, abs=1e-9)
    assert space.tool.high == pytest.approx(places.max(axis=0) + radius_m, abs=1e-9)
    assert any(line.startswith("flange and load") for line in space.lines())


def test_the_elbow_box_holds_the_body_at_the_third_joint_of_a_ur():
    arm, plan = load_arm("ur5"), plan_to()
    model = model_from_arm(arm)
    data, places = model.createData(), []
    for q in positions(plan):
        pin.forwardKinematics(model, data, q)
        elbow = data.oMi[model.getJointId("elbow_joint")]
        # In ur5.yaml the elbow's housing lies 0.118 to 0.155 m along that joint's axis.
        places += [elbow.act(np.array([0.0, 0.0, z])) for z in (0.118, 0.155)]
    box = swept(plan, arm).elbow
    assert box.low == pytest.approx(np.min(places, axis=0) - 0.076, abs=1e-9)
    assert box.high == pytest.approx(np.max(places, axis=0) + 0.076, abs=1e-9)


@pytest.mark.parametrize(("arm", "link"), [("ur5e", 2), ("panda", 3), ("lab6", 2)])
def test_the_elbow_is_the_joint_in_the_middle(arm, link):
    assert {body.link for body in elbow_bodies(load_arm(arm))} == {link}


def test_the_text_has_degrees_and_metres_rounded_outwards():
    lines = swept(plan_to(), load_arm("ur5")).lines()
    assert lines[1].split() == ["shoulder_pan_joint", "0°", "to", "58°"]
    assert lines[2].split() == ["shoulder_lift_joint", "-69°", "to", "-40°"]
    assert [line.split()[0] for line in lines[-2:]] == ["flange", "elbow"]


def test_the_document_has_radians_and_metres():
    shown = swept(plan_to(), load_arm("ur5")).to_dict()
    assert shown["joints"][0] == {"name": "shoulder_pan_joint", "min_rad": 0.0, "max_rad": 1.0}
    assert set(shown["tool"]) == set(shown["elbow"]) == {"min_m", "max_m"}
