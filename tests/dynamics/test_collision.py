"""Collision distances: known poses, an independent optimiser, exactness of the path search."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.arms import Capsule, load_arm
from hil.arms.payload import Payload
from hil.core.errors import DataError
from hil.dynamics import (
    Box,
    CollisionModel,
    Environment,
    Plane,
    RobotModel,
    payload_capsule,
    smallest_along_paths,
)
from tests.support.dynamics_arms import UR_ARMS, dh_chain

UP = np.radians([0, -90, 0, -90, 0, 0])
"""Upright: every arm is clear of itself."""

HOME = np.radians([-90, -90, 90, -90, -90, 0])
"""The makers' home position."""

FOLDED = np.radians([0, -90, 175, 0, 0, 0])
"""Forearm folded back beside the upper arm, wrist in the upper arm."""

WRIST_IN_THE_FOOT = [
    ("ur5", ("base", "wrist 3"), [-169, 44, 157, 14, -177, 67]),
    ("ur5", ("shoulder", "wrist 3"), [13, -6, 166, -34, -140, 15]),
    ("ur3", ("base", "wrist 2"), [-78, 6, 129, -31, -8, -11]),
    ("ur10e", ("shoulder", "wrist 3"), [-45, 47, -165, -125, 166, 6]),
]

UPPER_ARM_TUBE, FOREARM_TUBE = 4, 7
"""Indices of the UR5's capsules."""

angles = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6).map(np.array)


def sampled_path(seed: int, samples: int = 700) -> np.ndarray:
    """A few smooth legs with dwells between them, (samples, 6)."""
    random = np.random.default_rng(seed)
    arm = load_arm("ur5")
    corners = random.uniform(arm.excite_min, arm.excite_max, (6, 6))
    s = np.clip(np.linspace(0, 5.4, samples) % 1.0 * 1.25, 0, 1)
    leg = np.minimum(np.linspace(0, 5.4, samples).astype(int), 4)
    s = s * s * (3 - 2 * s)
    return corners[leg] + s[:, None] * (corners[leg + 1] - corners[leg])


@pytest.mark.thorough
@pytest.mark.parametrize("name", UR_ARMS)
@pytest.mark.parametrize("q", [UP, HOME])
def test_ordinary_poses_are_clear(name, q):
    model = CollisionModel(load_arm(name), Environment(table_z=0.0))
    assert model.clearance(q[None])[0] > 0.02


@pytest.mark.parametrize("name", UR_ARMS)
def test_a_folded_elbow_puts_the_wrist_into_the_upper_arm(name):
    distance, bodies = CollisionModel(load_arm(name)).closest(FOLDED)
    assert distance < 0
    assert bodies[0] in ("shoulder", "upper arm")
    assert bodies[1].startswith(("forearm", "wrist"))


@pytest.mark.parametrize(("name", "bodies", "q"), WRIST_IN_THE_FOOT)
def test_a_wrist_can_meet_the_foot_of_the_arm(name, bodies, q):
    distance, found = CollisionModel(load_arm(name)).closest(np.radians(q))
    assert distance < 0
    assert found == bodies


@pytest.mark.thorough
@pytest.mark.parametrize("name", [*UR_ARMS, "lab6"])
def test_most_of_the_excitation_range_is_usable(name):
    arm = load_arm(name)
    q = np.random.default_rng(0).uniform(arm.excite_min, arm.excite_max, (500, arm.n_joints))
    clear = CollisionModel(arm, Environment(table_z=0.0)).clearance(q) > 0.02
    assert clear.mean() > 0.2


def with_bodies(*numbers: int):
    """A UR5 of which only some capsules are left."""
    arm = load_arm("ur5")
    return replace(arm, capsules=tuple(arm.capsules[i] for i in numbers))


def ends_of(capsule: Capsule, q: np.ndarray) -> np.ndarray:
    """(2, 3) ends of a capsule's axis by the textbook DH chain."""
    frame = dh_chain("ur5", q)[capsule.link]
    return np.array([(frame @ [*end, 1.0])[:3] for end in (capsule.a, capsule.b)])


@pytest.mark.parametrize("name", ["ur5", "ur10e", "lab6"])
def test_distances_equal_those_of_coal(name):
    coal = pytest.importorskip("coal")
    arm = load_arm(name)
    model = CollisionModel(arm)
    shapes = [_coal_capsule(coal, capsule) for capsule in arm.capsules]
    for q in np.random.default_rng(3).uniform(-np.pi, np.pi, (25, 6)):
        frames = dh_chain(name, q)
        poses = [frames[c.link] @ at for c, (_, at) in zip(arm.capsules, shapes, strict=True)]
        least = min(
            coal.distance(
                *(shapes[i][0], coal.Transform3s(poses[i][:3, :3], poses[i][:3, 3])),
                *(shapes[j][0], coal.Transform3s(poses[j][:3, :3], poses[j][:3, 3])),
                coal.DistanceRequest(),
                coal.DistanceResult(),
            )
            for i, j in model.pairs
        )
        assert model.clearance(q[None])[0] == pytest.approx(least, abs=1e-9)


def _coal_capsule(coal, capsule: Capsule):
    """The shape, which lies along its own z, and its pose in the link's frame."""
    a, b = np.array(capsule.a, dtype=float), np.array(capsule.b, dtype=float)
    pose, length = np.eye(4), float(np.linalg.norm(b - a))
    if length:
        pose[:3, :3] = Rotation.align_vectors([b - a], [[0, 0, 1]])[0].as_matrix()
    pose[:3, 3] = 0.5 * (a + b)
    return coal.Capsule(capsule.radius, length), pose


def test_table_is_as_far_as_the_lowest_point_of_the_arm():
    arm = with_bodies(UPPER_ARM_TUBE, FOREARM_TUBE)
    model = CollisionModel(arm, Environment(table_z=-0.2))
    for q in np.random.default_rng(4).uniform(-np.pi, np.pi, (10, 6)):
        lowest = min(ends_of(capsule, q)[:, 2].min() - capsule.radius for capsule in arm.capsules)
        distance, bodies = model.closest(q)
        assert distance == pytest.approx(lowest + 0.2)
        assert bodies[1] == "table"


@pytest.mark.parametrize("table_z", [0.0, -0.01])
def test_the_base_may_stand_on_the_table(table_z):
    model = CollisionModel(load_arm("ur5"), Environment(table_z=table_z))
    assert model.clearance(UP[None])[0] > 0.02


def test_a_wall_is_met_at_its_distance_whatever_the_length_of_its_normal():
    door = Plane((-1.0, 5.0, 3.0), (7.0, 0.0, 0.0), "door")
    arm = with_bodies(FOREARM_TUBE)
    model = CollisionModel(arm, Environment(walls=(door,)))
    # Stretched out along −x, the tube ends 5.5 cm before the axis of wrist 1.
    expected = 1.0 - (0.425 + 0.39225 - 0.055) - arm.capsules[0].radius
    distance, bodies = model.closest(np.zeros(6))
    assert distance == pytest.approx(expected)
    assert bodies == ("forearm", "door")


@pytest.mark.parametrize(
    ("centre", "size", "distance"),
    [
        ((-0.2, -0.136, 0.689159), (0.1, 0.1, 0.2), 0.5),  # above its middle
        ((-0.2, -0.636, 0.589159), (0.1, 0.2, 0.2), np.hypot(0.4, 0.4)),  # edge to edge
        ((0.5, 0.364, 0.589159), (0.2, 0.2, 0.2), np.sqrt(0.4**2 * 3)),  # corner to its end
        ((-0.2, -0.136, 0.089159), (0.1, 0.1, 0.1), 0.0),  # through it
    ],
)
def test_a_box_is_as_far_as_its_nearest_face_edge_or_corner(centre, size, distance):
    # Stretched out, the upper arm's axis runs from (0, −0.136, d1) to (−0.425, −0.136, d1).
    arm = with_bodies(UPPER_ARM_TUBE)
    model = CollisionModel(arm, Environment(boxes=(Box(centre, size, "crate"),)))
    found, bodies = model.closest(np.zeros(6))
    assert found == pytest.approx(distance - arm.capsules[0].radius, abs=1e-6)
    assert bodies == ("upper arm", "crate")


def test_a_payload_is_part_of_the_arm():
    arm = load_arm("ur5")
    body = payload_capsule(Payload(3.0, (0.0, 0.0, 0.1)), arm.n_joints)
    flange = RobotModel.from_arm("ur5").flange_pose(HOME[None])[0]
    np.testing.assert_allclose(flange[:3, 2], [0, 0, -1], atol=1e-12)
    table_z = flange[2, 3] - 0.25
    distance, bodies = CollisionModel(arm, Environment(table_z), body).closest(HOME)
    assert bodies == ("payload", "table")
    assert distance == pytest.approx(0.25 - 0.2 - body.radius)


def test_payload_body_is_sized_by_mass_and_centre():
    assert payload_capsule(Payload(), 6) is None
    bar = payload_capsule(Payload(5.0, (0.0, 0.0, 0.1)), 6)
    assert bar == Capsule(6, (0.0, 0.0, 0.0), (0.0, 0.0, 0.2), bar.radius)
    volume_of_bar = np.pi * bar.radius**2 * 0.2
    assert volume_of_bar * 2700 == pytest.approx(5.0)
    ball = payload_capsule(Payload(5.0), 6)
    assert 4 / 3 * np.pi * ball.radius**3 * 2700 == pytest.approx(5.0)
    assert payload_capsule(Payload(0.01), 6).radius == 0.03
    assert payload_capsule(Payload(0.01), 6, radius=0.07).radius == 0.07


@pytest.mark.parametrize("seed", range(4))
def test_the_path_search_is_the_least_of_all_samples(seed):
    q = sampled_path(seed)
    box = Box((0.5, 0.3, 0.4), (0.2, 0.2, 0.2))
    wall = Plane((0.0, 0.9, 0.0), (0.0, -1.0, 0.0))
    for around in (Environment(), Environment(-0.2), Environment(0.0, (wall,), (box,))):
        model = CollisionModel(load_arm("ur5"), around)
        every = model.clearance(q)
        (least,), (index,) = smallest_along_paths([q], model.distances, model.reach)
        assert least == pytest.approx(every.min(), abs=1e-9)
        assert every[index] == least


def test_paths_that_are_searched_together_are_told_apart():
    model = CollisionModel(load_arm("ur5"), Environment(-0.2))
    q = sampled_path(5)
    paths = [q[:1], q[1:40], q[40:41], q[41:500], q[500:]]
    least, index = smallest_along_paths(paths, model.distances, model.reach)
    alone = [smallest_along_paths([path], model.distances, model.reach) for path in paths]
    np.testing.assert_array_equal(index, [one[1][0] for one in alone])
    np.testing.assert_allclose(least, [model.clearance(path).min() for path in paths], atol=1e-9)
    np.testing.assert_allclose(model.clearances(paths), least, rtol=0, atol=0)


@pytest.mark.parametrize("seed", range(4))
def test_the_path_search_tells_which_paths_keep_a_distance(seed):
    model = CollisionModel(load_arm("ur5"), Environment(-0.2))
    paths = np.split(sampled_path(seed), 20)
    least = np.array([model.clearance(path).min() for path in paths])
    for enough in (*np.quantile(least, [0.2, 0.5, 0.8]), least[3], np.nextafter(least[3], 1.0)):
        np.testing.assert_array_equal(model.clearances(paths, enough) >= enough, least >= enough)


def test_the_path_search_finds_a_dip_of_a_single_sample():
    model = CollisionModel(load_arm("ur5"))
    q = np.tile(HOME, (100, 1))
    q[53] = FOLDED
    (least,), (index,) = smallest_along_paths([q], model.distances, model.reach)
    assert index == 53
    assert least == pytest.approx(model.clearance(FOLDED[None])[0])


def test_the_path_search_skips_what_is_proven_clear():
    model = CollisionModel(load_arm("ur5"), Environment(table_z=0.0))
    asked = []
    distances = model.distances
    model.distances = lambda q: asked.append(len(q)) or distances(q)
    q = sampled_path(7, samples=20000)
    smallest_along_paths([q], model.distances, model.reach)
    assert sum(asked) < 0.1 * len(q)


def test_a_path_of_one_sample_is_a_path():
    model = CollisionModel(load_arm("ur5"))
    (least,), (index,) = smallest_along_paths([HOME[None]], model.distances, model.reach)
    assert (least, index) == (model.clearance(HOME[None])[0], 0)


@pytest.mark.parametrize("q", [np.empty((0, 6)), np.array([HOME, HOME * np.nan])])
def test_a_path_that_cannot_be_checked_is_refused(q):
    model = CollisionModel(load_arm("ur5"))
    with pytest.raises(DataError, match="path has no samples, or positions that are not finite"):
        smallest_along_paths([q], model.distances, model.reach)


def test_where_nothing_is_checked_nothing_is_close():
    arm = load_arm("ur5")
    model = CollisionModel(replace(arm, capsules=arm.capsules[:1]))
    assert model.closest(HOME) == (np.inf, ("", ""))


@settings(max_examples=60, deadline=None)
@given(q=angles, step=angles)
def test_clearance_changes_no_faster_than_the_arm_can_move(q, step):
    # No point of a UR5 is farther than its reach from any joint axis: 0.95 m with the capsules.
    model = _ur5_in_a_cell()
    small = 1e-3 * step
    near, far = model.clearance(np.array([q, q + small]))
    assert abs(far - near) <= 1.1 * np.abs(small).sum() + 1e-9


@settings(max_examples=60, deadline=None)
@given(q=angles, turn=st.floats(-np.pi, np.pi))
def test_self_clearance_does_not_care_where_the_arm_faces(q, turn):
    model = _ur5_alone()
    turned = q.copy()
    turned[0] = turn
    first, second = model.clearance(np.array([q, turned]))
    assert first == pytest.approx(second, abs=1e-9)


@cache
def _ur5_alone() -> CollisionModel:
    return CollisionModel(load_arm("ur5"))


@cache
def _ur5_in_a_cell() -> CollisionModel:
    wall = Plane((0.0, 0.7, 0.0), (0.0, -1.0, 0.0))
    box = Box((0.5, -0.3, 0.2), (0.2, 0.3, 0.4))
    return CollisionModel(load_arm("ur5"), Environment(-0.1, (wall,), (box,)))
