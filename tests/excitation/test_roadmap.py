"""Ways between poses: straight when clear, else around, and never out of the connected part."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hil.core.errors import PlanError
from hil.core.typing import FloatArray
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace, draw_poses, roomy_poses
from tests.support.plan_parts import JointSpace, toy_workspace


def disc(q: FloatArray) -> FloatArray:
    """Forbidden: a disc of 0.6 rad around the origin."""
    return np.hypot(q[:, 0], q[:, 1]) - 0.6


def barrier(q: FloatArray) -> FloatArray:
    """Forbidden: a strip at 1 rad of the first joint, from limit to limit."""
    return np.abs(q[:, 0] - 1.0) - 0.1


def roadmap_in(workspace: Workspace) -> Roadmap:
    return Roadmap(workspace, roomy_poses(workspace, 32, seed=0))


def test_a_clear_straight_line_is_taken() -> None:
    roadmap = roadmap_in(toy_workspace(disc))
    start, goal = np.array([-1.0, 1.0]), np.array([1.0, 1.2])
    way = roadmap.way(start, goal)
    assert way is not None
    assert len(way) == 1
    np.testing.assert_array_equal(way[0].q_end, goal)


def test_a_blocked_line_is_led_around_with_every_sample_clear() -> None:
    roadmap = roadmap_in(toy_workspace(disc))
    start, goal = np.array([-1.0, 0.0]), np.array([1.0, 0.05])
    way = roadmap.way(start, goal)
    assert way is not None
    assert len(way) >= 2
    np.testing.assert_array_equal(way[0].q_start, start)
    np.testing.assert_array_equal(way[-1].q_end, goal)
    assert all(tuple(a.q_end) == tuple(b.q_start) for a, b in pairwise(way))
    for line in way:
        assert disc(line.sample(100.0).q).min() >= 0.02


def test_no_way_is_needed_to_where_one_is() -> None:
    roadmap = roadmap_in(toy_workspace(disc))
    here = np.array([1.0, 1.0])
    assert roadmap.way(here, here) == []


def test_a_pose_behind_a_barrier_has_no_way() -> None:
    roadmap = roadmap_in(toy_workspace(barrier))
    assert roadmap.way(np.array([0.0, 0.0]), np.array([1.4, 0.0])) is None


def test_the_roadmap_keeps_to_the_largest_connected_part() -> None:
    roadmap = roadmap_in(toy_workspace(barrier))
    assert np.all(roadmap.poses[:, 0] < 1.0)
    poses = np.array([[0.0, 0.0], [1.4, 0.0]])
    assert roadmap.seem_connected(poses).tolist() == [True, False]


def test_a_workspace_in_which_nothing_is_connected_is_refused() -> None:
    dust = toy_workspace(lambda q: np.where(np.abs(np.sin(40 * q)).min(axis=1) > 0.9, 0.1, -0.1))
    with pytest.raises(PlanError, match="no clear motion leads from one pose to another"):
        roadmap_in(dust)


def test_a_workspace_without_room_is_refused_with_the_clearance() -> None:
    with pytest.raises(PlanError, match=r"only 0 of 4096 .* keep 20 mm"):
        list(draw_poses(toy_workspace(lambda q: np.zeros(len(q))), seed=1))


def test_drawn_poses_fill_the_range_more_evenly_than_chance() -> None:
    poses = next(draw_poses(toy_workspace(), seed=3))[:200]
    share = (poses + 1.5) / 3.0
    assert np.all((share >= 0) & (share <= 1))
    counts, _, _ = np.histogram2d(*share.T, bins=5, range=[[0, 1], [0, 1]])
    # Chance gives a standard deviation of 2.8 around the mean of 8 a cell.
    assert np.std(counts) < 1.5


def test_drawn_poses_depend_on_the_seed_alone() -> None:
    first, again, other = (next(draw_poses(toy_workspace(), seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_asking_for_the_same_distances_again_costs_nothing() -> None:
    workspace = toy_workspace(disc)
    line = workspace.line(np.array([1.0, 1.0]), np.array([1.2, 1.0]))
    first = workspace.clearances([line, line])
    assert isinstance(workspace.collision, JointSpace)
    asked = workspace.collision.asked
    assert asked == len(line.sample(100.0))
    np.testing.assert_array_equal(workspace.clearances([line]), first[:1])
    assert workspace.collision.asked == asked
