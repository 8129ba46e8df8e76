"""Clearance and workspace: few samples are computed, every one is judged."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.typing import FloatArray, StructArray
from hil.dynamics import Box, CollisionModel, Environment, Plane, RobotModel, payload_capsule
from hil.dynamics.collision import FlangeSpace
from hil.dynamics.sample_distances import SampleDistances
from hil.engine.interlocks import InterlockContext, LeastDistance, Trip
from hil.planning.checks import flange_space
from tests.support.interlock_parts import NAMES, made, rows

LOAD = Payload(3.0, (0.0, 0.0, 0.05))
AROUND = Environment(
    table_z=0.0,
    walls=(Plane((0.7, 0.0, 0.0), (-1.0, -0.3, 0.0), "window"),),
    boxes=(Box((0.0, -0.6, 0.2), (0.3, 0.2, 0.4), "rack"),),
)
HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
MIN_M, MAX_M = (-0.5, -0.6, 0.1), (0.6, 0.5, 1.0)


@cache
def bodies(arm: str = "ur5") -> CollisionModel:
    description = load_arm(arm)
    return CollisionModel(description, AROUND, payload_capsule(LOAD, description.n_joints))


@cache
def space(tip_m: float = 0.1) -> FlangeSpace:
    low = [Plane(MIN_M, tuple(np.eye(3)[i]), f"{'xyz'[i]} of min_m") for i in range(3)]
    high = [Plane(MAX_M, tuple(-np.eye(3)[i]), f"{'xyz'[i]} of max_m") for i in range(3)]
    return FlangeSpace(load_arm("ur5"), [*low, *high], tip_m)


def wander(seed: int, count: int, step_rad: float) -> FloatArray:
    """(count, 6) a smooth random path through the joint space, in and out of everything."""
    random = np.random.default_rng(seed)
    speed = np.cumsum(random.normal(0.0, 0.2, (count, 6)), axis=0)
    speed *= step_rad / np.abs(speed).mean()
    return np.asarray(HOME + np.cumsum(speed, axis=0))


def first_trip(interlock: LeastDistance, block: StructArray, length: int) -> Trip | None:
    parts = (block[i : i + length] for i in range(0, len(block), length))
    return next((trip for part in parts if (trip := interlock.check(part))), None)


def random_positions(count: int, seed: int = 0) -> FloatArray:
    arm = load_arm("ur5")
    return np.random.default_rng(seed).uniform(arm.excite_min, arm.excite_max, (count, 6))


@pytest.mark.thorough
@pytest.mark.parametrize("length", [1, 7, 400])
@pytest.mark.parametrize("step_rad", [0.001, 0.02])
@pytest.mark.parametrize("measured", ["clearance", "workspace"])
def test_it_trips_at_the_very_sample_at_which_a_loop_over_all_finds_too_little(
    length: int, step_rad: float, measured: str
) -> None:
    slow = bodies() if measured == "clearance" else space()
    fast = SampleDistances(bodies()) if measured == "clearance" else slow
    tripped = 0
    for seed in range(6):
        q = wander(seed, 400, step_rad)
        brute = slow.distances(q).min(axis=0)
        # From below the least distance of the start to above it: some paths trip, some do not.
        for least in (0.2 * brute[0], 0.9 * brute[0], 0.5 * (brute.min() + brute[0])):
            interlock = LeastDistance(measured, fast, least)
            trip = first_trip(interlock, rows(400, q=q), length)
            bad = np.flatnonzero(brute < least - 1e-5)
            if trip is None:
                assert len(bad) == 0
                assert interlock.computed < 400
            else:
                tripped += 1
                at = round(trip.device_time * 125)
                assert brute[at] < least + 1e-5
                assert (brute[:at] >= least - 1e-5).all()
                assert trip.value == pytest.approx(1e3 * brute[at], abs=0.01) or brute[at] < 0
    assert tripped > 5


class Lever:
    """Distances that use their reach up to the last bit: 1 m, less what two joints turn."""

    names = (("lever", "stop"), ("lever", "wall"))
    reach = np.array([[0.5, 0, 0, 0, 0, 0], [0.2, 0.4, 0, 0, 0, 0]])

    def distances(self, q: FloatArray) -> FloatArray:
        return np.asarray(1.0 - self.reach @ q.T)

    def copy_for_thread(self) -> Lever:
        return self


@pytest.mark.parametrize(("joint", "trips_at"), [(0, 1.8), (1, 2.25), (2, np.inf)])
@pytest.mark.parametrize("step", [0.011, 0.13, 0.7])
def test_nothing_is_skipped_where_motion_really_uses_up_what_was_to_spare(
    joint: int, trips_at: float, step: float
) -> None:
    q = np.zeros((300, 6))
    q[:, joint] = step * np.arange(300)
    trip = first_trip(LeastDistance("lever", Lever(), 0.1), rows(300, q=q), 5)
    beyond = np.flatnonzero(q[:, joint] > trips_at + 1e-9)
    assert (None if trip is None else round(trip.device_time * 125)) == (
        int(beyond[0]) if len(beyond) else None
    )


@pytest.mark.parametrize("measured", [bodies(), space()], ids=["clearance", "workspace"])
def test_no_distance_changes_by_more_than_its_reach_allows(
    measured: CollisionModel | FlangeSpace,
) -> None:
    random = np.random.default_rng(3)
    a = random_positions(3000)
    sizes = 10.0 ** random.uniform(-4, 0, (3000, 1))
    b = a + sizes * random.normal(size=a.shape) * (random.random(a.shape) < 0.5)
    change = np.abs(measured.distances(b) - measured.distances(a))
    allowed = measured.reach @ np.abs(b - a).T
    assert (change <= allowed + 2e-6).all()
    # Not by an empty margin either: somewhere the bound is nearly used up.
    assert (change[allowed > 1e-3] / allowed[allowed > 1e-3]).max() > 0.9


def test_a_slow_program_needs_few_samples_computed() -> None:
    q = HOME + np.linspace(0.0, 1.0, 2000)[:, None] * np.array([0.8, 0.2, -0.2, 0.0, 0.0, 0.5])
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    assert first_trip(interlock, rows(2000, q=q), 1) is None
    assert interlock.computed < 200


def test_an_arm_that_stands_needs_one_sample_computed() -> None:
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    assert first_trip(interlock, rows(500, q=HOME), 1) is None
    assert interlock.computed == 1


@pytest.mark.parametrize("name", ["ur5", "ur10e", "lab6"])
def test_coal_and_numpy_agree_on_every_distance(name: str) -> None:
    arm = load_arm(name)
    q = np.random.default_rng(1).uniform(arm.excite_min, arm.excite_max, (300, arm.n_joints))
    ours, theirs = bodies(name).distances(q), SampleDistances(bodies(name)).distances(q)
    apart = ours > 1e-3
    np.testing.assert_allclose(theirs[apart], ours[apart], atol=1e-5)
    assert (theirs[~apart] < 1e-3 + 1e-5).all()


def test_the_trip_names_the_two_that_are_too_close() -> None:
    q = HOME.copy()
    q[1] = np.radians(-30.0)  # the upper arm down towards the table
    trip = LeastDistance("clearance", SampleDistances(bodies()), 0.01).check(rows(1, q=q))
    assert trip is not None
    assert "payload and table" in trip.text(NAMES)
    assert "at least 10 mm" in trip.text(NAMES)
    assert trip.joint == -1


def test_the_flange_is_where_pinocchio_says() -> None:
    q = random_positions(200, seed=5)
    poses = RobotModel.from_arm("ur5").flange_pose(q)
    flange, tip = poses[:, :3, 3], poses[:, :3, 3] + 0.1 * poses[:, :3, 2]
    found = dict(zip(space().names, space().distances(q), strict=True))
    for axis in range(3):
        for point, at in (("flange", flange), ("payload", tip)):
            low = found[point, f"{'xyz'[axis]} of min_m"]
            high = found[point, f"{'xyz'[axis]} of max_m"]
            np.testing.assert_allclose(low, at[:, axis] - MIN_M[axis], atol=1e-9)
            np.testing.assert_allclose(high, MAX_M[axis] - at[:, axis], atol=1e-9)


def workspace() -> InterlockContext:
    flange = partial(flange_space, load_arm("ur5"), sizes=[None, (0.1, 0.03)])
    return InterlockContext(joint_names=NAMES, flange=flange)


@pytest.mark.parametrize(
    ("entry", "beyond"),
    [
        ({"min_m": [0.0, -2.0, -2.0]}, "payload and x of min_m"),
        ({"max_m": [2.0, 2.0, 0.7]}, "flange and z of max_m"),
        (
            {"planes": [{"name": "door", "point_m": [0, 0, 0.5], "normal": [0, 0, -2]}]},
            "flange and door",
        ),
    ],
)
def test_a_flange_or_payload_outside_the_workspace_trips(entry: Any, beyond: str) -> None:
    inside = made(workspace(), kind="workspace", min_m=[-2, -2, -2], max_m=[2, 2, 2])
    assert inside.check(rows(q=HOME)) is None
    # Stretched straight up, the tool axis level: the flange is 1 m high, the tip reaches to −y.
    up = np.radians([-90.0, -90.0, 0.0, -90.0, 0.0, 0.0])
    trip = made(workspace(), kind="workspace", **entry).check(rows(q=up))
    assert trip is not None
    assert beyond in trip.text(NAMES)


def test_positions_that_are_not_measured_trip_while_the_arm_moves() -> None:
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    block = rows(q=HOME)
    block["q"][1, 2] = np.nan
    assert interlock.check(block) is None
    block["status"] = 1
    trip = interlock.check(block)
    assert trip is not None
    assert "j3 not measured" in trip.text(NAMES)
    block["q"][1, 2] = np.inf
    assert interlock.check(block) is not None
    # What is measured again is judged again.
    assert interlock.check(rows(q=HOME, moving=True)) is None


def test_positions_that_are_not_measured_trip_where_the_set_point_changes() -> None:
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    block = rows(q=HOME, q_target=HOME)
    assert interlock.check(block) is None
    block["q"][:, 2] = np.nan
    assert interlock.check(block) is None
    assert interlock.check(rows(q=np.nan, q_target=HOME + 1e-4)) is not None


def test_it_is_clear_again_some_way_beyond_the_least_distance() -> None:
    least = float(bodies().clearance(HOME[None])[0])
    assert LeastDistance("c", bodies(), least - 0.001).check(rows(q=HOME)) is None
    assert not LeastDistance("c", bodies(), least - 0.001).clear(rows(q=HOME))
    assert LeastDistance("c", bodies(), least - 0.01).clear(rows(q=HOME))


def test_half_of_what_the_plan_keeps_is_the_default() -> None:
    context = InterlockContext(clearance=SampleDistances(bodies()), clearance_m=0.02)
    assert made(context, kind="clearance").watches == "10 mm"  # type: ignore[attr-defined]
    assert made(context, kind="clearance", least_m=0.004).watches == "4 mm"  # type: ignore[attr-defined]
