"""What one particular mock robot is really like: every parameter, frozen and serialisable.

Nothing in `hil` can read this. It is written to a file only to score what was identified.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hil.core import DataError, write_replacing

Profile = Literal["ideal", "full"]
SCHEMA = 1


@dataclass(frozen=True, slots=True)
class LinkTruth:
    """One link's inertial parameters in its distal DH frame.

    Attributes:
        mass_kg: Mass.
        com_m: Centre of mass.
        inertia_kgm2: (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass.
    """

    mass_kg: float
    com_m: tuple[float, float, float]
    inertia_kgm2: tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class DriveTruth:
    """Motor and gear of one joint, seen at the joint: eq. 16 of the static friction paper.

    Attributes:
        rotor_kgm2: Inertia of the rotor reflected through the gear.
        gain_nm_a: K1, torque per current.
        square_nm_a2: K2, torque per signed squared current.
        constant_nm: K0, torque at no current.
        ripple_nm: Amplitude of the gear's torque ripple.
        ripple_per_turn: Ripple periods per joint turn.
        ripple_phase_rad: Phase of the ripple at q = 0.
    """

    rotor_kgm2: float
    gain_nm_a: float
    square_nm_a2: float
    constant_nm: float
    ripple_nm: float
    ripple_per_turn: float
    ripple_phase_rad: float


@dataclass(frozen=True, slots=True)
class FrictionTruth:
    """Friction of one joint: Maxwell slip elements under a Stribeck limit, plus a viscous law.

    With no `elements` there is no presliding and Coulomb friction is Fc·tanh(v/smooth_rad_s).

    Attributes:
        coulomb_nm: Fc at the reference temperature, forward and backward averaged.
        stribeck_nm: Breakaway minus Coulomb friction at 20 °C.
        stribeck_rad_s: Stribeck velocity.
        stribeck_shape: Exponent δ in exp(−|v/vs|^δ).
        viscous_nm: Viscous torque at 1 rad/s and the reference temperature.
        viscous_power: Exponent a in Fv·|v|^a·sign(v).
        load_share: Friction per transmitted torque.
        asymmetry: Relative difference of forward to mean friction.
        offset_nm: Constant torque.
        elements: (share of the limit, displacement at which it slips [rad]) per slip element.
        slip_s: Time in which a slipping element follows a falling limit.
        creep_s: Time in which elements relax at standstill.
        creep_floor: Share of an element's limit below which it does not relax.
        smooth_rad_s: Width of the smooth sign when there are no elements.
    """

    coulomb_nm: float
    stribeck_nm: float
    stribeck_rad_s: float
    stribeck_shape: float
    viscous_nm: float
    viscous_power: float
    load_share: float
    asymmetry: float
    offset_nm: float
    elements: tuple[tuple[float, float], ...]
    slip_s: float
    creep_s: float
    creep_floor: float
    smooth_rad_s: float


@dataclass(frozen=True, slots=True)
class ThermalTruth:
    """How one joint warms up and what that does to its friction.

    Attributes:
        idle_k: Warming by the powered electronics alone.
        resistance_k_w: Warming per watt of loss.
        copper_w_a2: Winding loss per squared current.
        tau_s: Time constant.
        coulomb_per_k: Relative change of Coulomb friction per kelvin.
        viscous_per_k: Relative change of viscous friction per kelvin.
    """

    idle_k: float
    resistance_k_w: float
    copper_w_a2: float
    tau_s: float
    coulomb_per_k: float
    viscous_per_k: float


@dataclass(frozen=True, slots=True)
class SensorTruth:
    """Noise of one joint's measurements (standard deviations) and its current quantum.

    Attributes:
        rest_a: Current noise at standstill.
        moving_a: Current noise well above `Truth.noise_speed_rad_s`.
        quantum_a: Resolution of the reported current, 0 for none.
        q_rad: Position noise.
        qd_rad_s: Velocity noise while moving.
        qd_rest_rad_s: True speed below which the reported velocity is exactly 0.
    """

    rest_a: float
    moving_a: float
    quantum_a: float
    q_rad: float
    qd_rad_s: float
    qd_rest_rad_s: float


@dataclass(frozen=True, slots=True)
class JointTruth:
    """One joint: drive, friction, heat, sensors, and the friction its controller believes in.

    Attributes:
        feedforward_coulomb_nm: Coulomb friction the controller compensates.
        feedforward_load_share: Friction per joint torque the controller compensates.
        feedforward_viscous_nm_s: Viscous friction the controller compensates.
    """

    drive: DriveTruth
    friction: FrictionTruth
    thermal: ThermalTruth
    sensor: SensorTruth
    feedforward_coulomb_nm: float
    feedforward_load_share: float
    feedforward_viscous_nm_s: float


@dataclass(frozen=True, slots=True)
class Truth:
    """A mock robot, complete.

    Attributes:
        arm: Name of the published description it deviates from.
        seed, profile: What it was drawn from.
        ranges: Version of the frozen parameter ranges.
        links, joints: Per link and joint, base to flange.
        ambient_c: Mean temperature of the room.
        ambient_swing_k, ambient_period_s, ambient_phase_rad: Its slow drift.
        reference_c: Temperature the friction parameters hold at.
        noise_speed_rad_s: Speed at which current noise is half way to its moving level.
        schema: Version of this record.
    """

    arm: str
    seed: int
    profile: Profile
    ranges: int
    links: tuple[LinkTruth, ...]
    joints: tuple[JointTruth, ...]
    ambient_c: float
    ambient_swing_k: float
    ambient_period_s: float
    ambient_phase_rad: float
    reference_c: float
    noise_speed_rad_s: float
    schema: int = SCHEMA

    def to_json(self, path: Path | str) -> Path:
        """Write the truth to `path`, whole or not at all; returns the path.

        Raises:
            RecordingError: The file cannot be written.
        """
        write_replacing(Path(path), (json.dumps(asdict(self), indent=1) + "\n").encode())
        return Path(path)

    @staticmethod
    def from_json(path: Path | str) -> Truth:
        """Read a truth written by `to_json`.

        Raises:
            DataError: The file is missing, not JSON, or not a truth of this version.
        """
        hint = "write it again from the arm, seed and profile it belongs to"
        try:
            raw = json.loads(Path(path).read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: not a readable truth file: {error}", hint=hint) from error
        if not isinstance(raw, dict) or raw.get("schema") != SCHEMA:
            raise DataError(f"{path}: not a truth file of schema {SCHEMA}", hint=hint)
        try:
            truth: Truth = _build(Truth, raw)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: damaged truth file: {error!r}", hint=hint) from error
        return truth


def _build(kind: Any, raw: Any) -> Any:
    """Turn parsed JSON into the nested dataclasses and tuples that `kind` describes."""
    if hasattr(kind, "__dataclass_fields__"):
        types = get_type_hints(kind)
        return kind(**{f.name: _build(types[f.name], raw[f.name]) for f in fields(kind)})
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        repeated = len(inner) == 2 and inner[1] is Ellipsis
        kinds = [inner[0]] * len(raw) if repeated else list(inner)
        return tuple(_build(k, value) for k, value in zip(kinds, raw, strict=True))
    return raw if get_origin(kind) is Literal else kind(raw)
