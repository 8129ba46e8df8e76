"""What a plan sweeps: time, joint ranges, and the boxes of tool and elbow."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.dynamics import load_model
from hil.dynamics.build import model_from_arm
from hil.excitation.motion import Hold, Line
from hil.planning.plan import LoadStep, Plan, Step
from hil.planning.swept_space import elbow_bodies, swept

RATE_HZ = 125.0
HERE = (0.0, -1.2, 1.0, -1.5, 0.2, 0.0)
THERE = (1.0, -0.7, -0.6, -1.0, -0.4, 2.0)


def plan_of(arm="ur5", *, size_m=None, goal=THERE):
    way = Line(HERE, goal, 1.0, 2.0, 20.0, RATE_HZ)
    steps = (Step(0, "payload"), Step(1, "move", way), Step(2, "dwell", Hold(goal), pose=0))
    names = load_arm(arm).joint_names
    return Plan("p", arm, names, RATE_HZ, steps, (LoadStep(Payload(), size_m=size_m),))


def positions(plan):
    return np.vstack([np.array(HERE), plan.motions[0].sample(RATE_HZ).q])


def test_joint_ranges_reach_from_where_the_arm_stands_to_the_furthest_set_point():
    space = swept(plan_of(), load_arm("ur5"))
    assert space.q_min == pytest.approx(np.minimum(HERE, THERE))
    assert space.q_max == pytest.approx(np.maximum(HERE, THERE))


def test_the_duration_is_that_of_the_plan():
    plan = plan_of()
    assert swept(plan, load_arm("ur5")).duration_s == plan.duration_s


def test_the_tool_box_is_that_of_the_flange_at_every_set_point():
    plan = plan_of()
    places = load_model("ur5").flange_pose(positions(plan))[:, :3, 3]
    box = swept(plan, load_arm("ur5")).tool
    assert box.low == pytest.approx(places.min(axis=0), abs=1e-9)
    assert box.high == pytest.approx(places.max(axis=0), abs=1e-9)


def test_the_tool_box_includes_a_load_of_known_size():
    length_m, radius_m = 0.3, 0.05
    plan = plan_of(size_m=(length_m, radius_m))
    poses = load_model("ur5").flange_pose(positions(plan))
    places = np.vstack([poses[:, :3, 3], poses[:, :3, 3] + length_m * poses[:, :3, 2]])
    space = swept(plan, load_arm("ur5"))
    assert space.tool.low == pytest.approx(places.min(axis=0) - radius_m, abs=1e-9)
    assert space.tool.high == pytest.approx(places.max(axis=0) + radius_m, abs=1e-9)
    assert any(line.startswith("flange and load") for line in space.lines())


def test_the_elbow_box_holds_the_body_at_the_third_joint_of_a_ur():
    arm, plan = load_arm("ur5"), plan_of()
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
    lines = swept(plan_of(), load_arm("ur5")).lines()
    assert lines[1].split() == ["shoulder_pan_joint", "0°", "to", "58°"]
    assert lines[2].split() == ["shoulder_lift_joint", "-69°", "to", "-40°"]
    assert [line.split()[0] for line in lines[-2:]] == ["flange", "elbow"]


def test_the_document_has_radians_and_metres():
    shown = swept(plan_of(), load_arm("ur5")).to_dict()
    assert shown["joints"][0] == {"name": "shoulder_pan_joint", "min_rad": 0.0, "max_rad": 1.0}
    assert set(shown["tool"]) == set(shown["elbow"]) == {"min_m", "max_m"}
