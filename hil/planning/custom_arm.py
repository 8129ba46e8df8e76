"""`hil new own-urdf`: an arm's description, a station and a first spec from its URDF.

What a URDF does not say is guessed, marked `GUESS` in the file, and told: the files work at once on
the mock, and a person has to put in what the maker knows before anything real moves. Limits that no
arm has (none at all, or degrees where radians belong) are refused or replaced.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hil.arms import ArmDescription, arm_from_dict
from hil.core import BoolArray, FloatArray, SpecError, look_into, quoted_scalar, shown
from hil.dynamics import CollisionModel, Described, Environment, described
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
    try:
        start = _start(urdf, arm_from_dict(robot, look_into(text)))
    except ValueError as error:
        raise SpecError(
            f"{urdf}: describes no arm: {error}", hint="see <inertial> of that link"
        ) from None
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


def _notes(found: Described, arm: Path, station: Path) -> list[str]:
    notes = [f"joints: {', '.join(found.joint_names)}"]
    for what, lacks in silent(found).values():
        joints = [found.joint_names[j] for j in np.flatnonzero(lacks)]
        notes += [f"the URDF has no {what} for {', '.join(joints)}: guessed"] if joints else []
    if found.rotor_inertia.any():
        rotors = zip(found.joint_names, found.rotor_inertia, strict=True)
        listed = ", ".join(f"{name} {_number(value)}" for name, value in rotors if value)
        notes.append(
            f"rotor inertias (armature=, kg·m²) are not taken over, a description has none and "
            f"fits identify them: {listed}"
        )
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


def can_be_mocked(drafts: list[Draft]) -> bool:
    """Whether the mock has drives for the arm that `own_arm_drafts` described."""
    return len(look_into(drafts[-1].text)["joints"]) == MOCKED_JOINTS


MOST_RAD = 4 * np.pi
"""Two turns to either side; arms with more turn endlessly."""

MOST_RAD_S = 50.0
"""Eight turns a second, far above any arm's joint: degrees, or a number that stands for none."""


def require_ranges(urdf: Path, found: Described) -> None:
    """Refuse joints that cannot move, or that turn so far that their limits must be degrees.

    Raises:
        SpecError: With a line for each such joint.
    """
    ranges = [*zip(found.joint_names, found.q_min, found.q_max, strict=True)]
    stuck = [f"joint '{name}' has no range ({a:g} to {b:g})" for name, a, b in ranges if a >= b]
    far = [
        f"joint '{name}' turns from {a:g} to {b:g} rad, {(b - a) / (2 * np.pi):.0f} turns; are its "
        "limits in degrees?"
        for name, a, b in ranges
        if np.isfinite(b - a) and max(-a, b) > MOST_RAD
    ]
    if stuck:
        hint = (
            "give its <limit> `lower` and `upper` in radians, or make it of type fixed or, "
            "if it turns endlessly, continuous"
        )
    else:
        hint = (
            "a URDF has radians: 150° is 2.618 (and `velocity` has rad/s); a joint that turns "
            "endlessly is of type continuous"
        )
    if stuck or far:
        raise SpecError("\n".join(f"{urdf}: {line}" for line in stuck + far), hint=hint)


def without_odd_speeds(found: Described) -> tuple[Described, list[str]]:
    """The arm without speed limits that none has, and a line for people where it had some."""
    odd = np.flatnonzero(found.qd_max > MOST_RAD_S)
    if not len(odd):
        return found, []
    told = ", ".join(f"{found.joint_names[j]} {found.qd_max[j]:g} rad/s" for j in odd)
    kept = np.where(found.qd_max > MOST_RAD_S, 0.0, found.qd_max)
    return replace(found, qd_max=kept), [
        f"speed limits that no arm has (are they degrees per second?): {told}: not taken"
    ]


ACCELERATION_PER_SPEED = 3.0
"""Guessed limit [1/s]: full speed in a third of a second."""

EFFORT_NM, SPEED_DEG_S = 50.0, 90.0
GEAR_RATIO, DRIVE_GAIN_NM_A = 100, 10.0
RANGE_DEG, MARGIN_DEG = 120.0, 5.0

SLENDER = 0.05
"""Radius of guessed bodies, as a share of the arm's length."""

NEVER_SAID = (
    "rate_hz", "payload_max", "excite", "qdd_max", "gear_ratio", "drive_gain", "capsules",
)  # fmt: skip
"""What no URDF says."""

_HEAD = """# An arm of one's own, from {urdf}; a station names this file as `model`.
#
# What that file says is here in standard (distal) DH frames; units are in the keys. What a URDF
# does not say is guessed, in lines marked GUESS: good enough for the mock.
# Before anything real moves:
#
#   limits      from the data sheet; hil plans up to them
#   qdd_max     how hard a joint may accelerate
#   excite      the range in which programs move, unless a spec says otherwise
#   gear_ratio  motor turns per turn of the joint
#   drive_gain  torque at the joint per motor current; `hil gains` calibrates it
#   capsules    bodies that are kept apart: everything of a link must be inside its own
#
# Then take its word out of `guessed`: until the list is empty no real arm is moved with this file,
# or only with --waive, which is not taken for q_limits, qd_max, qdd_max and capsules.
#
# Friction is nowhere here: the mock draws its own, real arms have theirs, and `hil` identifies it.
guessed: [{guessed}]
sources:
  all: {source}
rate_hz: 250  # GUESS of the controller
payload_max_kg: 1  # GUESS
"""


def arm_text(urdf: str, found: Described) -> str:
    """The YAML file; lines with a guess are marked `GUESS`.

    Args:
        urdf: Its name, for people.
        found: What it says.
    """
    joints = "\n".join(_joint(found, j) for j in range(len(found.mass)))
    links = "\n".join(_link(found, j) for j in range(len(found.mass)))
    return (
        _HEAD.format(
            urdf=shown(urdf),
            source=quoted_scalar(f"{urdf}, but for lines marked GUESS"),
            guessed=", ".join(_guessed(found)),
        )
        + f"joints:\n{joints}\nlinks:\n{links}\n{_bodies(found)}"
    )


def _joint(found: Described, j: int) -> str:
    a, alpha, d, theta = found.dh[j]
    low, high = _limits(found.q_min[j], found.q_max[j])
    speed = np.degrees(found.qd_max[j]) or SPEED_DEG_S
    effort = found.effort_max[j] or EFFORT_NM
    narrow = _excited(low, high)
    said = {
        "q_min_deg": low, "q_max_deg": high, "qd_max_deg_s": speed,
        "effort_max_nm": effort,
    }  # fmt: skip
    excited = {"excite_min_deg": narrow[0], "excite_max_deg": narrow[1]}
    drive = {
        "qdd_max_deg_s2": speed * ACCELERATION_PER_SPEED,
        "gear_ratio": GEAR_RATIO,
        "drive_gain_nm_a": DRIVE_GAIN_NM_A,
    }
    dh = {"a_m": a, "alpha_deg": np.degrees(alpha), "d_m": d, "theta_deg": np.degrees(theta)}
    silent = found.effort_max[j] == 0 or found.qd_max[j] == 0 or not np.isfinite(found.q_min[j])
    told = "  # GUESS what the URDF leaves out" if silent else ""
    return (
        f"  - {{name: {quoted_scalar(found.joint_names[j])}, {_row(dh)},\n"
        f"     {_row(said)},{told}\n"
        f"     {_row(excited)},  # GUESS\n"
        f"     {_row(drive)}}}  # GUESS"
    )


def _limits(low: float, high: float) -> tuple[float, float]:
    """Degrees; an endless joint is given a turn to either side."""
    return (
        float(np.degrees(low)) if np.isfinite(low) else -360.0,
        float(np.degrees(high)) if np.isfinite(high) else 360.0,
    )


def _excited(low: float, high: float) -> tuple[float, float]:
    """Degrees; inside the limits, and not far from zero where they let it be near."""
    margin = min(MARGIN_DEG, (high - low) / 4)
    low, high = low + margin, high - margin
    near = max(low, -RANGE_DEG), min(high, RANGE_DEG)
    return near if near[0] < near[1] else (low, high)


def _row(values: dict[str, float]) -> str:
    return ", ".join(f"{key}: {_number(value)}" for key, value in values.items())


def _number(value: float) -> str:
    return f"{round(float(value), 9) + 0.0:.10g}"


def _link(found: Described, j: int) -> str:
    body = found.inertia[j]
    six = np.array([body[0, 0], body[1, 1], body[2, 2], body[0, 1], body[0, 2], body[1, 2]])
    return (
        f"  - {{name: {quoted_scalar(found.link_names[j])}, mass_kg: {_number(found.mass[j])}, "
        f"com_m: {_numbers(found.com[j])},\n     inertia_kgm2: {_numbers(six)}}}"
    )


def _numbers(values: FloatArray) -> str:
    return "[" + ", ".join(map(_number, values)) + "]"


def _guessed(found: Described) -> list[str]:
    return [*NEVER_SAID, *(word for word, (_, lacks) in silent(found).items() if lacks.any())]


def _bodies(found: Described) -> str:
    """Rods from joint to joint, thinner towards the flange."""
    lengths = np.linalg.norm(found.axes[:, 1] - found.axes[:, 0], axis=1)
    n, radius = len(found.mass), round(SLENDER * float(lengths.sum()), 3)
    foot = max(float(found.dh[0, 2]) / 2, 0.01)
    lines = [f"  - {{link: 0, a_m: [0, 0, 0], b_m: [0, 0, {_number(foot)}], "
             f"radius_m: {_number(radius)}}}"]  # fmt: skip
    for j, (a, b) in enumerate(found.axes):
        thick = radius * (1 - 0.5 * j / max(n - 1, 1))
        lines.append(f"  - {{link: {j + 1}, a_m: {_numbers(a)}, b_m: {_numbers(b)}, "
                     f"radius_m: {_number(round(thick, 3))}}}")  # fmt: skip
    head = "capsules:  # GUESS rods from joint to joint; put bodies around your arm's real outline"
    return "\n".join([head, *lines, ""])


def silent(found: Described) -> dict[str, tuple[str, BoolArray]]:
    """What a URDF may leave out, by its words in the description: its name, and where it does."""
    return {
        "effort_max": ("torque limit", found.effort_max == 0),
        "qd_max": ("speed limit", found.qd_max == 0),
        "q_limits": ("position limits", ~np.isfinite(found.q_min)),
    }
