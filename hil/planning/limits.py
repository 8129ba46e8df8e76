"""What a spec asks of the arm against what the arm can do; every excess at once, with figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray, KeyPath
from hil.excitation import Space, outside
from hil.planning.interlocks import declared_space
from hil.spec import Dwell, Excess, ExperimentSpec, Fourier, Interlock, WorkspaceInterlock

TOLERANCE = 1e-9

SOME_POSES = 16384
"""Number of random poses tried; at least one must lie inside the workspace, because planning
needs several among that many."""


def excesses(
    spec: ExperimentSpec, arm: ArmDescription, robot_hz: float, clearance_m: float
) -> list[Excess]:
    """One for every value of `spec` that the robot cannot do.

    Args:
        spec: What is asked.
        arm: The limits.
        robot_hz: Rate at which the robot takes set-points and reports its state.
        clearance_m: Distance that the station keeps to everything.
    """
    ranges = [*_beyond_range(spec.excitation, arm), *_reference(spec, arm)]
    return [
        *_other_rate(spec, robot_hz),
        *_too_fast(spec.excitation, arm),
        *ranges,
        *([] if ranges else _confined(spec, arm, clearance_m)),
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


def _confined(spec: ExperimentSpec, arm: ArmDescription, clearance_m: float) -> Iterator[Excess]:
    """Yield what the workspace interlocks leave no room for, as far as it shows without a plan."""
    space = declared_space(spec.interlocks, arm, [load.size_m for load in spec.loads])
    if space is None:
        return
    if narrow := list(_too_narrow(spec.interlocks, clearance_m)):
        yield from narrow
        return
    if getattr(spec.excitation, "file", None) is None:  # else its poses are known, and looked at
        yield from _unreached(spec.excitation, arm, space, clearance_m)
    if spec.reference.q_deg is not None and (
        complaint := outside(space, np.radians(np.array(spec.reference.q_deg)), clearance_m)
    ):
        yield Excess(("reference", "q_deg"), complaint)


def _unreached(
    excitation: Dwell | Fourier, arm: ArmDescription, space: Space, clearance_m: float
) -> Iterator[Excess]:
    """Yield that drawn poses do not come inside a space, if none of many does."""
    low, high = draw_range(excitation, arm)
    some = low + np.random.default_rng(0).uniform(size=(SOME_POSES, arm.n_joints)) * (high - low)
    nearest = some[int(space.distances(some).min(axis=0).argmax())]
    if complaint := outside(space, nearest, clearance_m):
        yield Excess(
            ("interlocks",),
            f"none of {SOME_POSES} poses from the joint ranges is inside the workspace; closest "
            f"rejected pose: {complaint}",
        )


def _too_narrow(interlocks: Sequence[Interlock], clearance_m: float) -> Iterator[Excess]:
    """Yield each axis on which no room is left between the sides of all boxes together."""
    boxes = [
        (number, entry)
        for number, entry in enumerate(interlocks)
        if isinstance(entry, WorkspaceInterlock) and entry.enabled
    ]
    for i, axis in enumerate("xyz"):
        lows = [(box.min_m[i], number) for number, box in boxes if box.min_m is not None]
        highs = [(box.max_m[i], number) for number, box in boxes if box.max_m is not None]
        if not lows or not highs:
            continue
        (low, _), (high, number) = max(lows), min(highs)
        if high - low <= 2 * clearance_m:
            yield Excess(
                ("interlocks", number, "max_m", i),
                f"leaves {1e3 * (high - low):.0f} mm on {axis} from min_m; the station's "
                f"clearance_m takes {1e3 * clearance_m:.0f} mm off either side",
            )


def _outside(
    path: KeyPath, angles: Sequence[float], i: int, arm: ArmDescription
) -> Iterator[Excess]:
    low, high = float(np.degrees(arm.q_min[i])), float(np.degrees(arm.q_max[i]))
    for angle in angles:
        if not low - TOLERANCE <= angle <= high + TOLERANCE:
            yield Excess(
                path, f"{angle:g}° is beyond the {low:g}° to {high:g}° of {arm.joint_names[i]}"
            )
