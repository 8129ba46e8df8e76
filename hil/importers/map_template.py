"""Template of an import map, with a small recording that the map describes (`hil new map`)."""

from __future__ import annotations

import numpy as np

from hil.arms import load_arm
from hil.core import FloatArray
from hil.dynamics import RobotModel

RATE_HZ, DURATION_S = 100.0, 20.0

MAP = """\
# Map of the columns of a recording to quantities and units, for `hil import`.
# It describes the sample recording beside it; change it to describe yours.
# All keys: `hil explain columns`, or the page "Import map keys".
hil_map: 1
description: sample recording of a simulated @robot@
format: csv                  # or mat, ros2bag, ur_rtde, interleaved
header: true                 # the first line contains the names of the columns
delimiter: ","
robot: @robot@               # a built-in arm, or a URDF file
joint_names: [@joints@]
effort_kind: torque          # or current, with drive_gains_nm_a: one value per joint [N·m/A]
# drive_gains_nm_a: [@gains@]
# payload: {mass_kg: 1.2, com_m: [0, 0, 0.05]}
columns:                     # one column per joint, by name or by number from 1 ("2:7")
  t: {columns: time_s, unit: s}
  q: {columns: [@q@], unit: deg}
  qd: {columns: [@qd@], unit: deg/s}
  effort: {columns: [@effort@], unit: N·m}
"""


def sample_map(robot: str) -> tuple[str, str]:
    """Return the texts of a map (YAML) and of a recording (CSV) that the map describes.

    The recording contains 20 s of a simulated arm at 100 Hz, with Coulomb and viscous friction.

    Args:
        robot: Name of a built-in arm.

    Raises:
        SpecError: No built-in arm has this name.
    """
    arm = load_arm(robot)
    t, q, qd, qdd = _motion(len(arm.joint_names))
    torque = RobotModel.from_arm(robot).inverse_dynamics(q, qd, qdd)
    torque += 3.0 * np.tanh(qd / 0.01) + 2.0 * qd
    numbers = range(1, len(arm.joint_names) + 1)
    names = {part: [f"{part}{j}" for j in numbers] for part in ("q", "qd", "effort")}
    words = {f"@{part}@": ", ".join(columns) for part, columns in names.items()}
    words |= {
        "@robot@": robot,
        "@joints@": ", ".join(arm.joint_names),
        "@gains@": ", ".join("10" for _ in numbers),
    }
    text = MAP
    for mark, word in words.items():
        text = text.replace(mark, word)
    lines = [",".join(["time_s", *(name for columns in names.values() for name in columns)])]
    rows = np.column_stack([t, np.degrees(q), np.degrees(qd), torque])
    lines += [",".join(f"{value:.6g}" for value in row) for row in rows]
    return text, "\n".join(lines) + "\n"


def _motion(joints: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return time (N,) [s] and position, velocity and acceleration (N, joints) of sine waves."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    omega = 2 * np.pi * np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    random = np.random.default_rng(1)
    weight = random.normal(0.0, 1.0, (joints, 5)) / omega / 5
    phase = random.uniform(0.0, 2 * np.pi, (joints, 5))
    angle = omega * t[:, None, None] + phase  # (N, joints, harmonics)
    q = (weight * np.sin(angle)).sum(2)
    qd = (weight * omega * np.cos(angle)).sum(2)
    qdd = (-weight * omega**2 * np.sin(angle)).sum(2)
    return t, q, qd, qdd
