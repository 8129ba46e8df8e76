"""What a spec asks of the arm against what the arm can do; every excess at once, with figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.arms import ArmDescription
from hil.spec.experiment import Dwell, ExperimentSpec, Fourier
from hil.spec.judgeable import Excess
from hil.spec.source import Path
from hil.typing import FloatArray

TOLERANCE = 1e-9


def excesses(spec: ExperimentSpec, arm: ArmDescription, robot_hz: float) -> list[Excess]:
    """One for every value of `spec` that the robot cannot do.

    Args:
        spec: What is asked.
        arm: The limits.
        robot_hz: Rate at which the robot takes set-points and reports its state.
    """
    return [
        *_other_rate(spec, robot_hz),
        *_too_fast(spec.excitation, arm),
        *_beyond_range(spec.excitation, arm),
        *_reference(spec, arm),
        *(
            Excess(
                ("loads", i, "mass_kg"),
                f"{load.mass_kg:g} kg is beyond the {arm.payload_max_kg:g} kg the {arm.name} "
                "is rated for",
            )
            for i, load in enumerate(spec.loads)
            if load.mass_kg > arm.payload_max_kg
        ),
    ]


def draw_range(excitation: Dwell | Fourier, arm: ArmDescription) -> tuple[FloatArray, FloatArray]:
    """(n,) least and (n,) most joint position that excitation draws [rad]."""
    if excitation.range_deg is None:
        return arm.excite_min, arm.excite_max
    low, high = np.radians(np.array(excitation.range_deg)).T
    return low, high


def _other_rate(spec: ExperimentSpec, robot_hz: float) -> Iterator[Excess]:
    asked = spec.record.rate_hz
    if asked is not None and abs(asked - robot_hz) > 1e-6 * robot_hz:
        yield Excess(
            ("record", "rate_hz"),
            f"{asked:g} Hz, but the robot runs at {robot_hz:g} Hz: "
            "leave it out, or set the rate in the station's options",
        )


def _too_fast(excitation: Dwell | Fourier, arm: ArmDescription) -> Iterator[Excess]:
    for key, asked, unit, limits in (
        ("max_velocity_deg_s", excitation.max_velocity_deg_s, "°/s", arm.qd_max),
        ("max_acceleration_deg_s2", excitation.max_acceleration_deg_s2, "°/s²", arm.qdd_max),
    ):
        weakest = int(np.argmin(limits))
        most = float(np.degrees(limits[weakest]))
        if asked > most * (1 + TOLERANCE):
            yield Excess(
                ("excitation", key),
                f"{asked:g} {unit} is beyond the {most:g} {unit} of {arm.joint_names[weakest]}",
            )


def _beyond_range(excitation: Dwell | Fourier, arm: ArmDescription) -> Iterator[Excess]:
    if excitation.range_deg is None:
        return
    if len(excitation.range_deg) != arm.n_joints:
        yield Excess(
            ("excitation", "range_deg"),
            f"{len(excitation.range_deg)} ranges, but the {arm.name} has {arm.n_joints} joints",
        )
        return
    for i, (low, high) in enumerate(excitation.range_deg):
        yield from _outside(("excitation", "range_deg", i), (low, high), i, arm)


def _reference(spec: ExperimentSpec, arm: ArmDescription) -> Iterator[Excess]:
    q_deg = spec.reference.q_deg
    if q_deg is None:
        return
    if len(q_deg) != arm.n_joints:
        yield Excess(
            ("reference", "q_deg"),
            f"{len(q_deg)} angles, but the {arm.name} has {arm.n_joints} joints",
        )
        return
    for i, angle in enumerate(q_deg):
        yield from _outside(("reference", "q_deg", i), (angle,), i, arm)


def _outside(path: Path, angles: Sequence[float], i: int, arm: ArmDescription) -> Iterator[Excess]:
    low, high = float(np.degrees(arm.q_min[i])), float(np.degrees(arm.q_max[i]))
    for angle in angles:
        if not low - TOLERANCE <= angle <= high + TOLERANCE:
            yield Excess(
                path, f"{angle:g}° is beyond the {low:g}° to {high:g}° of {arm.joint_names[i]}"
            )
