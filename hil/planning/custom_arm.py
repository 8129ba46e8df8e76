"""Files for a custom arm (`hil new own-urdf`): arm description, station and first spec from a URDF.

Values that a URDF does not contain are guessed, marked `GUESS` in the file, and reported. The files
can be used immediately on the mock; before a real arm moves, an operator has to enter the
manufacturer's values. Implausible limits (missing limits, or limits in degrees instead of radians)
are refused or replaced.
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
"""Number of joints for which the mock has drives."""

POSES, SEED = 400, 0


def own_arm_drafts(
    urdf: Path, spec: Path, *, robot: str, name: str
) -> tuple[list[Draft], list[str]]:
    """Return the files for a custom arm, and notes about them.

    Args:
        urdf: Path of the URDF file of the arm.
        spec: Path of the spec; description and station are written into the same folder.
        robot: Name of the robot in the station.
        name: Name of the experiment.

    Returns:
        Drafts of spec, station and arm description, and one note for each value that the URDF
        lacks.

    Raises:
        SpecError: The URDF is not usable, or the arm has no collision-free pose.
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
            f"{urdf}: is not a valid arm description: {error}", hint="check <inertial> of this link"
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
    """Return the pose with the most free space among random poses, in whole degrees [rad].

    The mock of the arm is switched on in this pose.
    """
    model = CollisionModel(arm, Environment())
    drawn = np.random.default_rng(SEED).uniform(
        np.degrees(arm.excite_min), np.degrees(arm.excite_max), (POSES, arm.n_joints)
    )
    poses = np.radians(np.round(drawn))
    clearance = model.clearance(poses)
    if clearance.max() <= 0:
        raise SpecError(
            f"{urdf}: the arm collides with itself or its table in all of {POSES} random poses",
            hint="check that the joint limits are in radians and the lengths in metres",
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
            f"rotor inertias (armature=, kg·m²) are ignored, because an arm description has none "
            f"and fits identify them: {listed}"
        )
    notes.append(
        f"a URDF has no acceleration limits, gear ratios, drive gains, rated payload, friction or "
        f"simple collision bodies: check the lines marked GUESS in {arm} before a real arm moves"
    )
    if len(found.mass) != MOCKED_JOINTS:
        notes.append(
            f"the mock has drives for {MOCKED_JOINTS} joints, but this arm has {len(found.mass)}: "
            f"`hil validate`, `plan` and `run` require a different driver in {station}, see "
            "docs/how-to/add-a-driver.md"
        )
    return notes


def can_be_mocked(drafts: list[Draft]) -> bool:
    """Return whether the mock has drives for an arm described by `own_arm_drafts`."""
    return len(look_into(drafts[-1].text)["joints"]) == MOCKED_JOINTS


MOST_RAD = 4 * np.pi
"""Largest plausible joint position [rad]: two turns to either side; joints with a larger range
are endless."""

MOST_RAD_S = 50.0
"""Largest plausible joint speed [rad/s]: eight turns per second, faster than any real arm.

A larger joint speed in a URDF is probably in degrees per second, or means that the joint has no
speed limit.
"""


def require_ranges(urdf: Path, found: Described) -> None:
    """Raise if a joint cannot move, or has a range so large that its limits must be in degrees.

    Raises:
        SpecError: At least one joint has an invalid range; the message has one line per joint.
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
            "set `lower` and `upper` of its <limit> in radians, or change its type to fixed or, "
            "for endless rotation, to continuous"
        )
    else:
        hint = (
            "write radians: 150° is 2.618 (and rad/s for `velocity`); a joint with endless "
            "rotation has the type continuous"
        )
    if stuck or far:
        raise SpecError("\n".join(f"{urdf}: {line}" for line in stuck + far), hint=hint)


def without_odd_speeds(found: Described) -> tuple[Described, list[str]]:
    """Return the arm without implausible speed limits, and a note about the removed limits."""
    odd = np.flatnonzero(found.qd_max > MOST_RAD_S)
    if not len(odd):
        return found, []
    listed = ", ".join(f"{found.joint_names[j]} {found.qd_max[j]:g} rad/s" for j in odd)
    kept = np.where(found.qd_max > MOST_RAD_S, 0.0, found.qd_max)
    return replace(found, qd_max=kept), [
        f"implausible speed limits are ignored (are they in degrees per second?): {listed}"
    ]


ACCELERATION_PER_SPEED = 3.0
"""Ratio of the guessed acceleration limit to the speed limit [1/s]: full speed is reached in a
third of a second."""

EFFORT_NM, SPEED_DEG_S = 50.0, 90.0
GEAR_RATIO, DRIVE_GAIN_NM_A = 100, 10.0
RANGE_DEG, MARGIN_DEG = 120.0, 5.0

SLENDER = 0.05
"""Radius of the guessed collision bodies, as a share of the length of the arm."""

NEVER_SAID = (
    "rate_hz", "payload_max", "excite", "qdd_max", "gear_ratio", "drive_gain", "capsules",
)  # fmt: skip
"""Keys of the arm description for values that no URDF contains."""

_HEAD = """# Description of a custom arm, from {urdf}; a station names this file as `model`.
#
# The values of the URDF are converted to standard (distal) DH frames; the keys contain the units.
# Values that the URDF lacks are guessed, in lines marked GUESS; they are sufficient for the mock.
# Before a real arm moves, enter the correct values:
#
#   limits      limits from the data sheet; hil plans motions up to them
#   qdd_max     maximum acceleration of a joint
#   excite      range in which programs move, unless a spec has its own range
#   gear_ratio  motor revolutions per revolution of the joint
#   drive_gain  joint torque per motor current; `hil drive-gains` calibrates it
#   capsules    collision bodies; the capsules of a link must enclose the whole link
#
# Then remove the corrected name from the list `guessed`. A real arm moves only if this list is
# empty, or with --waive, which is not accepted for q_limits, qd_max, qdd_max and capsules.
#
# This file contains no friction: the mock draws its own, and `hil` identifies that of an arm.
guessed: [{guessed}]
sources:
  all: {source}
rate_hz: 250  # GUESS, rate of the controller
payload_max_kg: 1  # GUESS
"""


def arm_text(urdf: str, found: Described) -> str:
    """Return the YAML text of the arm description; guessed lines are marked `GUESS`.

    Args:
        urdf: Name of the URDF file, which is written into the comments.
        found: Arm data from the URDF.
    """
    joints = "\n".join(_joint(found, j) for j in range(len(found.mass)))
    links = "\n".join(_link(found, j) for j in range(len(found.mass)))
    return (
        _HEAD.format(
            urdf=shown(urdf),
            source=quoted_scalar(f"{urdf}, except the lines marked GUESS"),
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
    mark = "  # GUESS values that the URDF lacks" if silent else ""
    return (
        f"  - {{name: {quoted_scalar(found.joint_names[j])}, {_row(dh)},\n"
        f"     {_row(said)},{mark}\n"
        f"     {_row(excited)},  # GUESS\n"
        f"     {_row(drive)}}}  # GUESS"
    )


def _limits(low: float, high: float) -> tuple[float, float]:
    """Return the position limits in degrees; an endless joint gets one turn to either side."""
    return (
        float(np.degrees(low)) if np.isfinite(low) else -360.0,
        float(np.degrees(high)) if np.isfinite(high) else 360.0,
    )


def _excited(low: float, high: float) -> tuple[float, float]:
    """Return the joint range of the excitation in degrees, inside the position limits.

    The excitation range is restricted to angles near zero if the position limits allow this.
    """
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
    """Return the YAML text of the guessed collision bodies.

    The guessed collision bodies are rods between the joints, thinner towards the flange.
    """
    lengths = np.linalg.norm(found.axes[:, 1] - found.axes[:, 0], axis=1)
    n, radius = len(found.mass), round(SLENDER * float(lengths.sum()), 3)
    foot = max(float(found.dh[0, 2]) / 2, 0.01)
    lines = [f"  - {{link: 0, a_m: [0, 0, 0], b_m: [0, 0, {_number(foot)}], "
             f"radius_m: {_number(radius)}}}"]  # fmt: skip
    for j, (a, b) in enumerate(found.axes):
        thick = radius * (1 - 0.5 * j / max(n - 1, 1))
        lines.append(f"  - {{link: {j + 1}, a_m: {_numbers(a)}, b_m: {_numbers(b)}, "
                     f"radius_m: {_number(round(thick, 3))}}}")  # fmt: skip
    head = "capsules:  # GUESS rods from joint to joint; replace them to enclose the real links"
    return "\n".join([head, *lines, ""])


def silent(found: Described) -> dict[str, tuple[str, BoolArray]]:
    """Return the values that a URDF may lack, by key of the description.

    Each entry contains the name of the quantity and a mask of the joints for which the quantity is
    missing.
    """
    return {
        "effort_max": ("torque limit", found.effort_max == 0),
        "qd_max": ("speed limit", found.qd_max == 0),
        "q_limits": ("position limits", ~np.isfinite(found.q_min)),
    }
