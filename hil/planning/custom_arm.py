"""`hil new own-urdf`: an arm's description, a station and a first spec from its URDF.

What a URDF does not say is guessed, marked `GUESS` in the file, and told: the files work at once on
the mock, and a person has to put in what the maker knows before anything real moves.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from hil.arms import ArmDescription, arm_from_dict
from hil.core import FloatArray, SpecError
from hil.dynamics import CollisionModel, Described, Environment, described
from hil.planning.custom_arm_limits import require_ranges, without_odd_speeds
from hil.planning.custom_arm_text import arm_text, silent
from hil.spec import Draft, render

MOCKED_JOINTS = 6
"""The mock has drives for so many."""
POSES, SEED = 400, 0


def own_arm_drafts(
    urdf: Path, spec: Path, *, robot: str, name: str
) -> tuple[list[Draft], list[str]]:
    """The files for an arm of somebody's own, and what is to be known about them.

    Args:
        urdf: The arm.
        spec: Where the spec goes; description and station stand beside it.
        robot: What the robot is called in the station.
        name: What the experiment is called.

    Returns:
        Spec, station and description; a line for each thing that the URDF did not say.

    Raises:
        SpecError: The URDF cannot be used, or the arm has no pose that is clear.
    """
    found = described(urdf)
    require_ranges(urdf, found)
    found, odd = without_odd_speeds(found)
    station, arm = (spec.with_name(f"{spec.stem}-{part}.yaml") for part in ("station", "arm"))
    text = arm_text(urdf.name, found)
    start = _start(urdf, arm_from_dict(robot, yaml.safe_load(text)))
    words = {
        "robot": robot, "name": name, "arm": arm.name, "urdf": urdf.name,
        "start": ", ".join(f"{angle:.0f}" for angle in np.degrees(start)),
        "ones": ", ".join(["1"] * len(found.mass)), "station": str(station), "file": str(spec),
    }  # fmt: skip
    drafts = [
        Draft(spec, render("own-urdf", words)),
        Draft(station, render("own-urdf.station", words)),
        Draft(arm, text),
    ]
    return drafts, odd + _notes(found, arm, station)


def can_be_mocked(drafts: list[Draft]) -> bool:
    """Whether the mock has drives for the arm that `own_arm_drafts` described."""
    return len(yaml.safe_load(drafts[-1].text)["joints"]) == MOCKED_JOINTS


def _notes(found: Described, arm: Path, station: Path) -> list[str]:
    notes = [f"joints: {', '.join(found.joint_names)}"]
    for what, lacks in silent(found).values():
        joints = [found.joint_names[j] for j in np.flatnonzero(lacks)]
        notes += [f"the URDF has no {what} for {', '.join(joints)}: guessed"] if joints else []
    notes.append(
        f"a URDF knows no accelerations, gears, currents, payload, friction and no lean collision "
        f"bodies: see GUESS in {arm} before anything real moves"
    )
    if len(found.mass) != MOCKED_JOINTS:
        notes.append(
            f"the mock has drives for {MOCKED_JOINTS} joints and cannot be this arm of "
            f"{len(found.mass)}: `hil validate`, `plan` and `run` work once {station} names "
            "another driver, see docs/how-to/add-a-driver.md"
        )
    return notes


def _start(urdf: Path, arm: ArmDescription) -> FloatArray:
    """The roomiest of some poses, in whole degrees [rad]: where the mock is switched on."""
    model = CollisionModel(arm, Environment())
    drawn = np.random.default_rng(SEED).uniform(
        np.degrees(arm.excite_min), np.degrees(arm.excite_max), (POSES, arm.n_joints)
    )
    poses = np.radians(np.round(drawn))
    clearance = model.clearance(poses)
    if clearance.max() <= 0:
        raise SpecError(
            f"{urdf}: in none of {POSES} poses would the arm be clear of itself and its table",
            hint="see whether its joint limits are radians and its lengths metres",
        )
    return np.asarray(poses[clearance.argmax()])
