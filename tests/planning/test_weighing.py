"""Where a plan weighs its loads, and the key `weigh`."""

from __future__ import annotations

import json
from functools import cache
from itertools import groupby

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil.dynamics import CollisionModel, Environment, RobotModel
from hil.dynamics.collision import payload_capsule
from hil.planning.plan import Plan, Step
from hil.planning.plan_preview import preview
from hil.planning.weighing import why_not_weighed, why_plan_not_weighed
from hil.robot import Capabilities
from hil.spec.documentation import schema_of
from hil.spec.experiment import ExperimentSpec
from hil.spec.load import spec_from_text
from tests.support.plan_parts import plan_of, samples_between
from tests.support.weighing_parts import CYLINDER, bodies, sweep

# Where a plan weighs its loads: the same way for each, clear, bearable, and telling


HEAVY = {"mass_kg": 5, "com_m": [0, 0, 0.08]}


@cache
def plan() -> Plan:
    """Three loads, with a warm-up before the first."""
    return sweep({}, CYLINDER, HEAVY, warm_up={"duration_s": 5}, reference={"every": 1})


def weighings(plan: Plan, load: int) -> list[Step]:
    return [step for step in plan if step.kind == "weigh" and step.load == load]


def positions(plan: Plan, load: int) -> np.ndarray:
    return np.array([step.motion.q_end for step in weighings(plan, load) if step.motion])


@pytest.mark.thorough
@pytest.mark.parametrize("load", range(3))
def test_every_load_is_weighed_after_it_is_mounted_and_before_anything_else(load: int) -> None:
    kinds = [step.kind for step in plan() if step.load == load]
    first = kinds.index("payload")
    stays = [kind for kind, _ in groupby(kinds[first:]) if kind != "move"]
    own = ["payload", *["weigh"] * 4]
    assert stays[:5] == own
    assert stays[5] == ("warmup" if load == 0 else "reference")


def test_every_load_is_weighed_at_the_same_poses_from_the_same_sides() -> None:
    ways = [[(s.pose, s.approach) for s in weighings(plan(), load)] for load in range(3)]
    assert ways[0] == [(0, 1), (0, -1), (1, 1), (1, -1)]
    assert ways[0] == ways[1] == ways[2]
    for load in (1, 2):
        np.testing.assert_array_equal(positions(plan(), load), positions(plan(), 0))


def test_every_joint_arrives_from_below_then_from_above() -> None:
    for step in (s for load in range(3) for s in weighings(plan(), load)):
        before = plan().steps[step.index - 1]
        assert before.motion is not None
        way = before.motion.q_end - before.motion.q_start
        np.testing.assert_allclose(way, step.approach * np.radians(3.0))


def test_a_run_can_pause_before_every_weighing_pose_and_not_between_its_sides() -> None:
    for load in range(3):
        group = [step for step in plan() if step.load == load]
        first = next(i for i, step in enumerate(group) if step.kind == "payload")
        last = max(i for i, step in enumerate(group) if step.kind == "weigh")
        poses = [step.index for step in weighings(plan(), load)]
        checks = [s.index for s in group[first : last + 1] if s.checkpoint]
        assert len(checks) == 3
        payload, one, two = checks
        assert payload < one < poses[0]
        assert poses[1] < two < poses[2]


def test_motions_stay_connected() -> None:
    for (_, q), (start, _) in zip(
        samples_between(plan()), samples_between(plan())[1:], strict=False
    ):
        np.testing.assert_allclose(start, q[-1], atol=1e-9)


@pytest.mark.thorough
def test_weighing_takes_less_than_half_a_minute_per_load() -> None:
    bare = sweep({}, CYLINDER, HEAVY, warm_up={"duration_s": 5}, weigh=False)
    assert not any(step.kind == "weigh" for step in bare)
    assert plan().duration_s - bare.duration_s < 3 * 30


def test_the_biggest_load_has_room_on_the_way_whatever_is_mounted() -> None:
    body = payload_capsule(Payload(5.0, (0.0, 0.0, 0.08)), load_arm("ur5").n_joints)
    distances = CollisionModel(load_arm("ur5"), Environment(table_z=0.0), body)
    first = next(s for s in weighings(plan(), 0)).index
    last = weighings(plan(), 0)[-1].index
    moves = [s.motion for s in plan().steps[first - 2 : last] if s.motion is not None]
    assert distances.clearance(np.vstack([m.sample(125.0).q for m in moves])).min() >= 0.02


def test_the_poses_tell_mass_and_centre_of_mass() -> None:
    """Torques per kg from the height of a point mass, by finite differences."""
    model = RobotModel.from_arm("ur5")

    def torques(point: tuple[float, float, float]) -> np.ndarray:
        def height(q: np.ndarray) -> np.ndarray:
            pose = model.flange_pose(q)
            return np.asarray((pose[:, :3, :3] @ np.array(point) + pose[:, :3, 3])[:, 2])

        q = positions(plan(), 0)[::2]
        return np.array(
            [9.81 * (height(q + 1e-6 * e) - height(q - 1e-6 * e)) / 2e-6 for e in np.eye(6)]
        ).T

    at_flange = torques((0.0, 0.0, 0.0))
    assert np.abs(at_flange[:, 1:3]).max() > 6.0  # N·m per kg; a straight arm has 8.7
    beside = np.array([torques(tuple(0.1 * e)) - at_flange for e in np.eye(3)])
    wrist = beside[:, :, 3:].reshape(3, -1)
    assert np.linalg.svd(wrist, compute_uv=False).min() > 0.5  # N·m per 0.1 kg·m


@pytest.mark.thorough
def test_the_heaviest_load_can_be_held_at_every_pose() -> None:
    heavy = sweep({}, {"mass_kg": 5, "com_m": [0.1, 0, 0.3], "size_m": [0.4, 0.1]})
    model = RobotModel.from_arm("ur5").with_payload(heavy.loads[1].payload)
    torque = np.abs(model.gravity(positions(heavy, 1)))
    assert (torque <= 0.8 * load_arm("ur5").effort_max).all()


@pytest.mark.thorough
@pytest.mark.parametrize("poses", [1, 3])
def test_the_spec_says_how_many_poses_and_the_first_ones_stay(poses: int) -> None:
    chosen = sweep({}, CYLINDER, HEAVY, weigh={"poses": poses})
    assert {step.pose for step in weighings(chosen, 1)} == set(range(poses))
    shared = 2 * min(poses, 2)
    np.testing.assert_array_equal(positions(chosen, 1)[:shared], positions(plan(), 1)[:shared])


@pytest.mark.thorough
@pytest.mark.parametrize("off", [False, None, {"poses": 0}])
def test_weighing_can_be_switched_off(off: object) -> None:
    chosen = sweep({}, CYLINDER, weigh=off)
    assert not weighings(chosen, 0)
    assert chosen.weigh_dwell is None


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("loads", "reason"),
    [
        ([{}], "the same mass"),
        ([CYLINDER, CYLINDER], "the same mass"),
        ([CYLINDER, {}], "not the lightest"),
    ],
)
def test_what_cannot_be_weighed_is_not_and_has_a_reason(
    loads: list[dict[str, object]], reason: str
) -> None:
    chosen = sweep(*loads)
    assert not any(step.kind == "weigh" for step in chosen)
    torque = Capabilities(chosen.joint_names, 125.0, "torque")
    assert reason in why_plan_not_weighed(chosen, torque)


def test_a_sweep_is_weighed_unless_the_gains_are_unknown() -> None:
    names = plan().joint_names
    assert why_not_weighed([0.0, 3.0, 0.0], 2) == ""
    assert why_plan_not_weighed(plan(), Capabilities(names, 125.0, "torque")) == ""
    assert why_plan_not_weighed(plan(), Capabilities(names, 125.0, "current", (9.0,) * 6)) == ""
    told = why_plan_not_weighed(plan(), Capabilities(names, 125.0, "current"))
    assert "drive gains" in told


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ["ur3e", "lab6"])
def test_other_arms_are_weighed_on_too(arm: str) -> None:
    chosen = sweep(*bodies(0, 2), arm=arm)
    assert len(weighings(chosen, 1)) == 4


def test_weighing_dwells_have_a_rule_of_their_own_that_is_stored_with_the_plan() -> None:
    dwell = next(step for step in plan() if step.kind == "dwell")
    rule = plan().dwell_rule(weighings(plan(), 0)[0])
    assert plan().dwell_rule(dwell) == plan().dwell
    assert rule.dwell_s == 1.0
    assert rule.samples == 25
    assert rule.settle_rad_s == plan().dwell.settle_rad_s
    again = Plan.from_dict(json.loads(json.dumps(plan().to_dict())))
    assert again == plan()
    assert again.hash == plan().hash


def test_plans_without_weighing_say_nothing_about_it() -> None:
    assert "weigh_dwell" not in plan_of().to_dict()


def test_weighing_is_no_part_of_what_is_measured() -> None:
    bare = sweep({}, CYLINDER, HEAVY, warm_up={"duration_s": 5}, reference={"every": 1}, weigh=None)
    assert plan().condition_number == pytest.approx(bare.condition_number)
    assert plan().waypoints == bare.waypoints == 1
    assert preview(plan()).steps["weigh"] == 12


def test_a_sweep_that_is_not_weighed_is_warned_of() -> None:
    assert not any("weighed" in warning for warning in preview(plan()).warnings)
    (*_, warning) = preview(sweep(CYLINDER, {})).warnings
    assert warning.startswith("no payload check: the first load")


# The key `weigh`: on by default, off in three spellings, nothing else under it


HEAD = "hil: 1\nname: a\nrobot: ur5\nexcitation: {kind: dwell}\n"


def spec(line: str = "") -> ExperimentSpec:
    return spec_from_text(HEAD + line)


def test_loads_are_weighed_at_two_poses_unless_the_spec_says_otherwise() -> None:
    weigh = spec().weigh
    assert weigh is not None
    assert (weigh.poses, weigh.tolerance_kg, weigh.tolerance_percent) == (2, 0.15, 10.0)


@pytest.mark.parametrize("off", ["false", "null", ""])
def test_the_key_can_be_off(off: str) -> None:
    assert spec(f"weigh: {off}\n").weigh is None


def test_no_poses_are_allowed_and_mean_the_same() -> None:
    weigh = spec("weigh: {poses: 0}\n").weigh
    assert weigh is not None
    assert weigh.poses == 0


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("weigh: {tolerance_g: 200}", "use tolerance_kg: 0.2"),
        ("weigh: {pose: 3}", "did you mean 'poses'?"),
        ("weigh: {poses: -1}", "weigh.poses: must be at least 0"),
        ("weigh: {tolerance_kg: 0}", "weigh.tolerance_kg: must be above 0 kg"),
        ("weigh: true", "must be a mapping with keys such as poses"),
        ("weigh: 3", "must be a mapping with keys such as poses"),
    ],
)
def test_slips_are_explained(line: str, told: str) -> None:
    with pytest.raises(SpecError) as refused:
        spec(line + "\n")
    assert told in refused.value.message
    assert len(refused.value.message.splitlines()) == 1


def test_editors_accept_what_is_accepted() -> None:
    allowed = schema_of("experiment")["properties"]["weigh"]["anyOf"]
    assert {"$ref": "#/$defs/Weigh"} in allowed
    assert any(entry.get("const") is False for entry in allowed)
    assert {"type": "null"} in allowed
