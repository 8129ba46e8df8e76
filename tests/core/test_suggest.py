"""'Did you mean …?' is asked about slips of typing, and not about whatever is least unlike."""

from __future__ import annotations

import time

import pytest

from hil.core.suggest import LONGEST_WORD, closest, did_you_mean

KEYS = ("waypoints", "seed", "dwell_s", "settle_rad_s", "max_velocity_deg_s", "max_jerk_deg_s3",
        "approach", "approach_deg", "range_deg", "file", "file_unit", "kind")  # fmt: skip
ESTIMATORS = ("rigid-wls", "rigid-ols", "static-wls", "static-mlp", "diffnea", "residual-network")
VERBS = ("csv", "npz", "parquet", "spec", "station", "series", "schedule")


@pytest.mark.parametrize(
    ("typed", "meant", "options"),
    [
        ("waypionts", "waypoints", KEYS),  # swapped
        ("cvs", "csv", VERBS),
        ("waypoint", "waypoints", KEYS),  # missing
        ("sed", "seed", KEYS),
        ("aproach", "approach", KEYS),
        ("seeed", "seed", KEYS),  # too many
        ("statoin", "station", VERBS),
        ("Waypoints", "waypoints", KEYS),  # case
        ("dwell-s", "dwell_s", KEYS),  # - against _
        ("rigid_wls", "rigid-wls", ESTIMATORS),
        ("RIGID_WSL", "rigid-wls", ESTIMATORS),
        ("residul-netwrok", "residual-network", ESTIMATORS),
        ("dwell", "dwell_s", KEYS),  # a part
        ("max_velocity", "max_velocity_deg_s", KEYS),
        ("velocity_max", "max_velocity_deg_s", KEYS),
        ("max_velocty", "max_velocity_deg_s", KEYS),
        ("points", "waypoints", KEYS),
        ("validation", "validate", ("robot", "validate", "accept")),  # a stem
        ("el7211", "el72xx", ("generic", "el72xx")),
        ("trajectory", "trajectories", ("trajectories", "waypoints")),
        ("file", "file", KEYS),
        (
            "max_velocity",
            "max_velocity_deg_s",
            ("max_velocty", "max_velocity_deg_s"),
        ),  # whole words
        ("joint_07", "joint_7", ("joint_1", "joint_7")),
        ("ur5-01-lfet", "ur5-01-left", ("ur5-01-right", "ur5-01-left", "ur5-02-left")),
        ("unwieghted", "unweighted", ("weighted", "unweighted")),
    ],
)
def test_a_slip_is_understood(typed: str, meant: str, options: tuple[str, ...]) -> None:
    assert closest(typed, options) == meant


@pytest.mark.parametrize(
    ("typed", "options"),
    [
        ("speed", VERBS),
        ("stopping", VERBS),
        ("banana", KEYS),
        ("mind_map", KEYS),
        ("velocity", ("acceleration", "quality_s")),
        ("network", ("rigid-wls", "twork_s", "static-wls")),
        ("deg", KEYS),
        ("s", KEYS),
        ("x", ("y", "z")),
        ("", KEYS),
        ("tolerance", ("reference", "clearance_m")),
        ("robots", ("root", "report")),
        ("ur5-003", ("ur5-001", "ur5-002")),  # another arm
        ("ur4", ("ur3", "ur5", "ur10")),
        ("0002-dwel", ("0001-dwell", "0003-dwell")),
        ("max_velocity", ("min_velocity",)),  # opposites
        ("no", ("on", "off")),
        ("--no-wait", ("--wait",)),
        ("unweighted", ("weighted",)),
        ("disabled", ("enabled",)),
        ("lower_limit_position", ("upper_limit_position",)),
        ("a" * (LONGEST_WORD + 1), ("a" * LONGEST_WORD,)),
    ],
)
def test_nonsense_is_not_guessed_at(typed: str, options: tuple[str, ...]) -> None:
    assert closest(typed, options) is None


def test_the_nearest_is_named_whatever_the_order() -> None:
    assert closest("ur10", ("ur1", "ur10e", "ur3")) == closest("ur10", ("ur3", "ur10e", "ur1"))
    assert closest("approach_dg", ("approach", "approach_deg")) == "approach_deg"


def test_what_there_is_is_listed_where_nothing_is_alike() -> None:
    assert did_you_mean("banana", VERBS[:3]) == "available: csv, npz, parquet"
    assert did_you_mean("cvs", VERBS[:3]) == "did you mean 'csv'?"
    assert did_you_mean("banana", ()) == "none is available"


def test_long_words_of_many_take_no_time() -> None:
    names = [f"{i:04d}-weekly-identification-of-the-welding-robot-left" for i in range(500)]
    began = time.process_time()
    closest("weekly-identification-of-the-wleding-robot-left-or-right", names)
    assert time.process_time() - began < 2
