"""What a mock robot is drawn from, and that it can be written down for scoring."""

import zlib
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from hil.arms import load_arm
from hil.core.errors import DataError, SpecError
from hil_mock_robot.mocks import EmbeddedMock
from hil_mock_robot.plant.truth import Truth, draw_truth, ranges

SEEDS = range(8)


def second_moments(link):
    xx, yy, zz, xy, xz, yz = link.inertia_kgm2
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.trace(inertia) / 2 * np.eye(3) - inertia


def test_ranges_of_version_1_are_frozen():
    text = files("hil_mock_robot").joinpath("ranges.yaml").read_bytes()
    assert (ranges()["version"], zlib.crc32(text)) == (1, 1151493310)


@pytest.mark.parametrize("arm", ["ur5", "lab6"])
@pytest.mark.parametrize("seed", SEEDS)
def test_masses_deviate_by_5_to_20_percent(arm, seed):
    masses = np.array([link.mass_kg for link in draw_truth(arm, seed).links])
    deviation = np.abs(masses / load_arm(arm).mass - 1)
    assert (deviation >= 0.05).all()
    assert (deviation <= 0.20).all()


@pytest.mark.parametrize("arm", ["ur5", "lab6"])
@pytest.mark.parametrize("seed", SEEDS)
def test_every_link_is_a_body_that_can_exist(arm, seed):
    for link in draw_truth(arm, seed).links:
        assert link.mass_kg > 0
        assert np.linalg.eigvalsh(second_moments(link)).min() > 0


def test_wrist_carries_a_rotor_that_dwarfs_its_own_inertia():
    wrist, link = draw_truth("ur5", 1).joints[5], draw_truth("ur5", 1).links[5]
    assert wrist.drive.rotor_kgm2 > 100 * link.inertia_kgm2[2]


def test_same_seed_gives_the_same_robot_and_another_seed_another_one():
    assert draw_truth("ur5", 3) == draw_truth("ur5", 3)
    assert draw_truth("ur5", 3) != draw_truth("ur5", 4)


def test_profiles_of_a_seed_share_bodies_rotors_and_gains():
    full, ideal = draw_truth("ur5", 3, "full"), draw_truth("ur5", 3, "ideal")
    assert full.links == ideal.links
    for a, b in zip(full.joints, ideal.joints, strict=True):
        assert (a.drive.rotor_kgm2, a.drive.gain_nm_a) == (b.drive.rotor_kgm2, b.drive.gain_nm_a)


def test_other_arms_scale_the_friction_of_the_ur5_by_their_torque_limits(monkeypatch):
    arm = load_arm("ur5")
    twice = replace(arm, name="twice", effort_max=2 * arm.effort_max)
    monkeypatch.setattr(
        "hil_mock_robot.plant.truth.published", lambda name: twice if name == "twice" else arm
    )
    low, high = ranges()["friction"]["coulomb"]
    for joint, reference in zip(
        draw_truth("twice", 0).joints, ranges()["arms"]["ur5"]["coulomb_nm"], strict=True
    ):
        assert low <= joint.friction.coulomb_nm / (2 * reference) <= high


@pytest.mark.parametrize("profile", ["ideal", "full"])
def test_truth_survives_a_round_trip_through_json(tmp_path, profile):
    path = EmbeddedMock().write_truth(tmp_path / "truth.json", "lab6", 5, profile)
    assert Truth.from_json(path) == draw_truth("lab6", 5, profile)


@pytest.mark.parametrize("text", ["", "[]", '{"schema": 99}', '{"schema": 1, "arm": "ur5"}'])
def test_damaged_truth_is_refused_with_its_name(tmp_path, text):
    path = tmp_path / "truth.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"truth\.json"):
        Truth.from_json(path)


def test_unknown_profile_and_arm_are_refused():
    with pytest.raises(SpecError, match="profile 'fast'"):
        draw_truth("ur5", 0, "fast")
    with pytest.raises(SpecError, match="arm 'ur99'"):
        draw_truth("ur99")
