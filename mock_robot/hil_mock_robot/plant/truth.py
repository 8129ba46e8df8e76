"""True parameters of one individual robot, drawn from frozen ranges (decision record 0007).

A `Truth` is immutable and serialisable. No code in `hil` can read a truth; a truth is written to a
file only to evaluate an identification. `draw_truth` draws the true parameters of one robot for an
arm, a seed and a profile.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from hil.arms import ArmDescription, load_arm
from hil.core import DataError, FloatArray, SpecError, look_into, write_replacing

Profile = Literal["ideal", "full"]
SCHEMA = 1


@dataclass(frozen=True, slots=True)
class LinkTruth:
    """Inertial parameters of one link in its distal DH frame.

    Attributes:
        mass_kg: Mass [kg].
        com_m: Centre of mass [m].
        inertia_kgm2: (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass [kg·m²].
    """

    mass_kg: float
    com_m: tuple[float, float, float]
    inertia_kgm2: tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class DriveTruth:
    """Motor and gear of one joint, on the joint side: eq. 16 of the static friction paper.

    Attributes:
        rotor_kgm2: Rotor inertia reflected through the gear [kg·m²].
        gain_nm_a: Coefficient K1, torque per current [N·m/A].
        square_nm_a2: Coefficient K2, torque per signed squared current [N·m/A²].
        constant_nm: Coefficient K0, torque at zero current [N·m].
        ripple_nm: Amplitude of the gear's torque ripple [N·m].
        ripple_per_turn: Number of ripple periods per turn of the joint.
        ripple_phase_rad: Phase of the ripple at q = 0 [rad].
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
    """Friction of one joint: Maxwell slip elements with a Stribeck limit, plus viscous friction.

    Without `elements` there is no presliding, and Coulomb friction is Fc·tanh(v/smooth_rad_s).

    Attributes:
        coulomb_nm: Coulomb friction Fc at the reference temperature, mean of both directions [N·m].
        stribeck_nm: Breakaway friction minus Coulomb friction at 20 °C [N·m].
        stribeck_rad_s: Stribeck velocity vs [rad/s].
        stribeck_shape: Exponent δ in exp(−|v/vs|^δ).
        viscous_nm: Viscous torque at 1 rad/s and the reference temperature [N·m].
        viscous_power: Exponent a in Fv·|v|^a·sign(v).
        load_share: Friction torque per unit of torque that the gear transmits.
        asymmetry: Relative difference between forward friction and mean friction.
        offset_nm: Constant part of the friction torque [N·m].
        elements: Pairs (share of the limit, displacement at which the element slips [rad]), one for
            each slip element.
        slip_s: Time constant with which a slipping element follows a decreasing limit [s].
        creep_s: Time constant with which slip elements relax at standstill [s].
        creep_floor: Share of an element's limit below which the element does not relax.
        smooth_rad_s: Width of the smooth sign function if there are no elements [rad/s].
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
    """Warming of one joint and its effect on friction.

    Attributes:
        idle_k: Warming by the powered electronics without motion [K].
        resistance_k_w: Warming per watt of loss [K/W].
        copper_w_a2: Winding loss per squared current [W/A²].
        tau_s: Thermal time constant [s].
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
    """Noise of one joint's measurements (standard deviations) and current resolution.

    Attributes:
        rest_a: Current noise at standstill [A].
        moving_a: Current noise far above `Truth.noise_speed_rad_s` [A].
        quantum_a: Resolution of the reported current [A]; 0 for none.
        q_rad: Position noise [rad].
        qd_rad_s: Velocity noise in motion [rad/s].
        qd_rest_rad_s: True speed below which the reported velocity is exactly 0 [rad/s].
    """

    rest_a: float
    moving_a: float
    quantum_a: float
    q_rad: float
    qd_rad_s: float
    qd_rest_rad_s: float


@dataclass(frozen=True, slots=True)
class JointTruth:
    """Drive, friction, heat and sensors of one joint, and the friction model of its controller.

    Attributes:
        feedforward_coulomb_nm: Coulomb friction that the controller compensates [N·m].
        feedforward_load_share: Friction torque per unit of joint torque that the controller
            compensates.
        feedforward_viscous_nm_s: Viscous friction that the controller compensates [N·m·s/rad].
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
    """All true parameters of a mock robot.

    Attributes:
        arm: Name of the published description from which the robot deviates.
        seed, profile: Seed and profile of the random draw.
        ranges: Version of the frozen parameter ranges.
        links, joints: Parameters per link and per joint, from base to flange.
        ambient_c: Mean room temperature [°C].
        ambient_swing_k, ambient_period_s, ambient_phase_rad: Slow drift of the room temperature.
        reference_c: Reference temperature of the friction parameters [°C].
        noise_speed_rad_s: Speed at which the current noise is halfway between its levels at
            standstill and in motion [rad/s].
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
        """Write the truth to `path` atomically; return the path.

        Raises:
            RecordingError: The file cannot be written.
        """
        write_replacing(Path(path), (json.dumps(asdict(self), indent=1) + "\n").encode())
        return Path(path)

    @staticmethod
    def from_json(path: Path | str) -> Truth:
        """Read a truth written by `to_json`.

        Raises:
            DataError: The file is missing, is not JSON, or is not a truth of this version.
        """
        hint = "create it again from its arm, seed and profile"
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
    """Convert parsed JSON into the nested dataclasses and tuples of type `kind`."""
    if hasattr(kind, "__dataclass_fields__"):
        types = get_type_hints(kind)
        return kind(**{f.name: _build(types[f.name], raw[f.name]) for f in fields(kind)})
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        repeated = len(inner) == 2 and inner[1] is Ellipsis
        kinds = [inner[0]] * len(raw) if repeated else list(inner)
        return tuple(_build(k, value) for k, value in zip(kinds, raw, strict=True))
    return raw if get_origin(kind) is Literal else kind(raw)


JOINTS = 6
"""Number of joints of the arms that the frozen ranges cover."""


@cache
def published(arm: str) -> ArmDescription:
    """Return the published description of an arm.

    The description is cached, because parsing takes longer than drawing a robot.
    """
    return load_arm(arm)


@cache
def ranges() -> dict[str, Any]:
    """Return the frozen parameter ranges."""
    text = files("hil_mock_robot").joinpath("ranges.yaml").read_text("utf-8")
    parsed: dict[str, Any] = look_into(text)
    return parsed


def draw_truth(arm: str = "ur5", seed: int = 0, profile: Profile = "full") -> Truth:
    """Return the robot that is drawn for an arm, a seed and a profile.

    The two profiles of a seed share bodies, rotors, K1 gains and noise. The profile `ideal` has
    only Coulomb and viscous friction, at one temperature, with a linear drive.

    Raises:
        SpecError: There is no such arm or profile, or the arm has a number of joints for which
            there are no drive data.
    """
    if profile not in ("ideal", "full"):
        raise SpecError(
            f"the mock has no profile {profile!r}", hint="use 'full' (every effect) or 'ideal'"
        )
    described = published(arm)
    if described.n_joints != JOINTS:
        raise SpecError(
            f"the mock simulates arms with {JOINTS} joints only; {arm} has {described.n_joints}",
            hint="simulate a six-joint arm, such as ur5 or lab6, or set another driver in the "
            "station: docs/how-to/add-a-driver.md",
        )
    truth = _draw_full(described, seed)
    return truth if profile == "full" else _idealise(truth)


def _draw_full(arm: ArmDescription, seed: int) -> Truth:
    table = ranges()
    dice = _Dice(np.random.default_rng([seed, zlib.crc32(Path(arm.name).stem.encode())]))
    thermal = table["thermal"]
    links = tuple(_draw_link(arm, i, dice) for i in range(arm.n_joints))
    base = _scaled_table(arm)
    joints = tuple(
        _draw_joint(arm, i, {key: float(column[i]) for key, column in base.items()}, dice)
        for i in range(arm.n_joints)
    )
    return Truth(
        arm=arm.name,
        seed=seed,
        profile="full",
        ranges=table["version"],
        links=links,
        joints=joints,
        ambient_c=dice.within(thermal["ambient_c"]),
        ambient_swing_k=dice.within(thermal["ambient_swing_k"]),
        ambient_period_s=dice.within(thermal["ambient_period_s"]),
        ambient_phase_rad=dice.within((0.0, 2 * np.pi)),
        reference_c=float(thermal["reference_c"]),
        noise_speed_rad_s=float(table["sensor"]["noise_speed_rad_s"]),
    )


class _Dice:
    """Random draws from one stream; the order of the calls is part of the frozen ranges."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def within(self, limits: Any) -> float:
        return float(self.rng.uniform(limits[0], limits[1]))

    def signed(self, limits: Any) -> float:
        return self.within(limits) * (1.0 if self.rng.random() < 0.5 else -1.0)

    def direction(self) -> FloatArray:
        vector = self.rng.standard_normal(3)
        return np.asarray(vector / np.linalg.norm(vector))

    def count(self, limits: Any) -> int:
        return int(self.rng.integers(limits[0], limits[1], endpoint=True))


def _draw_link(arm: ArmDescription, i: int, dice: _Dice) -> LinkTruth:
    limits = ranges()["bodies"]
    mass = float(arm.mass[i]) * (1 + dice.signed(limits["mass"]))
    gyration = float(np.sqrt(np.trace(arm.inertia[i]) / 2 / arm.mass[i]))
    com = arm.com[i] + dice.within(limits["com"]) * gyration * dice.direction()
    inertia = _perturbed_inertia(arm.inertia[i] * mass / arm.mass[i], limits, dice)
    xx, yy, zz = np.diag(inertia).tolist()
    xy, xz, yz = inertia[0, 1], inertia[0, 2], inertia[1, 2]
    x, y, z = com.tolist()
    return LinkTruth(mass, (x, y, z), (xx, yy, zz, float(xy), float(xz), float(yz)))


def _perturbed_inertia(inertia: FloatArray, limits: Any, dice: _Dice) -> FloatArray:
    """Stretch and tilt a rotational inertia.

    The perturbation applies to the second-moment matrix Σ = ½tr(I)·1 − I. Positive eigenvalues of Σ
    are the condition for physical consistency, so the perturbed inertia is physically consistent
    for any stretch.
    """
    second = np.trace(inertia) / 2 * np.eye(3) - inertia
    moments, axes = np.linalg.eigh(second)
    stretched = moments * np.array([1 + dice.signed(limits["inertia"]) for _ in range(3)])
    angle = np.radians(dice.within(limits["tilt_deg"]))
    tilted = _rotation(dice.direction(), float(angle)) @ axes
    second = tilted @ np.diag(stretched) @ tilted.T
    return np.asarray(np.trace(second) * np.eye(3) - second)


def _rotation(axis: FloatArray, angle: float) -> FloatArray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _scaled_table(arm: ArmDescription) -> dict[str, FloatArray]:
    """Return the arm's own parameter table, or that of the UR5 scaled by the torque limits.

    Thermal resistances are scaled by the inverse ratio of the torque limits.
    """
    arms = ranges()["arms"]
    if arm.name in arms:
        return {key: np.array(column) for key, column in arms[arm.name].items()}
    ratio = arm.effort_max / published("ur5").effort_max
    power = {"resistance_k_w": -1.0, "copper_w_a2": 0.0}
    return {key: np.array(c) * ratio ** power.get(key, 1.0) for key, c in arms["ur5"].items()}


def _draw_joint(arm: ArmDescription, i: int, base: dict[str, float], dice: _Dice) -> JointTruth:
    limits = ranges()["controller"]
    friction = _draw_friction(base, dice)
    drive = _draw_drive(arm, i, base, friction.coulomb_nm, dice)
    return JointTruth(
        drive=drive,
        friction=friction,
        thermal=_draw_thermal(base, dice),
        sensor=_draw_sensor(arm, i, base, dice),
        feedforward_coulomb_nm=friction.coulomb_nm * dice.within(limits["feedforward_coulomb"]),
        feedforward_load_share=friction.load_share * dice.within(limits["feedforward_load"]),
        feedforward_viscous_nm_s=friction.viscous_nm * dice.within(limits["feedforward_viscous"]),
    )


def _draw_friction(base: dict[str, float], dice: _Dice) -> FrictionTruth:
    limits = ranges()["friction"]
    coulomb = base["coulomb_nm"] * dice.within(limits["coulomb"])
    return FrictionTruth(
        coulomb_nm=coulomb,
        stribeck_nm=coulomb * dice.within(limits["stribeck"]),
        stribeck_rad_s=dice.within(limits["stribeck_rad_s"]),
        stribeck_shape=dice.within(limits["stribeck_shape"]),
        viscous_nm=base["viscous_nm"] * dice.within(limits["viscous"]),
        viscous_power=dice.within(limits["viscous_power"]),
        load_share=dice.within(limits["load_share"]),
        asymmetry=dice.signed(limits["asymmetry"]),
        offset_nm=coulomb * dice.signed(limits["offset"]),
        elements=_draw_elements(limits, dice),
        slip_s=dice.within(limits["slip_s"]),
        creep_s=dice.within(limits["creep_s"]),
        creep_floor=dice.within(limits["creep_floor"]),
        smooth_rad_s=0.0,
    )


def _draw_elements(limits: Any, dice: _Dice) -> tuple[tuple[float, float], ...]:
    """Return slip elements: shares of the limit sum to 1, slip displacements are evenly spaced.

    The largest slip displacement is the breakaway displacement.
    """
    count = dice.count(limits["elements"])
    breakaway = dice.within(limits["breakaway_rad"])
    shares = np.array([dice.within(limits["element_share"]) for _ in range(count)])
    shares /= shares.sum()
    return tuple((float(share), breakaway * (k + 1) / count) for k, share in enumerate(shares))


def _draw_drive(
    arm: ArmDescription, i: int, base: dict[str, float], coulomb: float, dice: _Dice
) -> DriveTruth:
    limits = ranges()["drive"]
    gain = float(arm.drive_gains[i]) * (1 + dice.signed(limits["gain"]))
    current = float(arm.effort_max[i]) / gain
    return DriveTruth(
        rotor_kgm2=base["rotor_kgm2"] * (1 + dice.signed(limits["rotor"])),
        gain_nm_a=gain,
        square_nm_a2=dice.within(limits["square"]) * gain / current,
        constant_nm=dice.signed(limits["constant"]) * float(arm.effort_max[i]),
        ripple_nm=dice.within(limits["ripple"]) * coulomb,
        ripple_per_turn=limits["ripple_per_motor_turn"] * float(arm.gear_ratio[i]),
        ripple_phase_rad=dice.within((0.0, 2 * np.pi)),
    )


def _draw_thermal(base: dict[str, float], dice: _Dice) -> ThermalTruth:
    limits = ranges()["thermal"]
    return ThermalTruth(
        idle_k=dice.within(limits["idle_k"]),
        resistance_k_w=base["resistance_k_w"] * dice.within(limits["resistance"]),
        copper_w_a2=base["copper_w_a2"],
        tau_s=dice.within(limits["tau_s"]),
        coulomb_per_k=dice.within(limits["coulomb_per_k"]),
        viscous_per_k=dice.within(limits["viscous_per_k"]),
    )


def _draw_sensor(arm: ArmDescription, i: int, base: dict[str, float], dice: _Dice) -> SensorTruth:
    limits = ranges()["sensor"]
    span = 2 * float(arm.effort_max[i] / arm.drive_gains[i])
    return SensorTruth(
        rest_a=base["rest_a"] * dice.within(limits["rest"]),
        moving_a=base["moving_a"] * dice.within(limits["moving"]),
        quantum_a=span / 2 ** int(limits["bits"]),
        q_rad=float(limits["q_rad"]),
        qd_rad_s=dice.within(limits["qd_rad_s"]),
        qd_rest_rad_s=float(limits["qd_rest_rad_s"]),
    )


def _idealise(truth: Truth) -> Truth:
    return replace(
        truth,
        profile="ideal",
        joints=tuple(_ideal_joint(joint) for joint in truth.joints),
        ambient_c=truth.reference_c,
        ambient_swing_k=0.0,
    )


def _ideal_joint(joint: JointTruth) -> JointTruth:
    friction = replace(
        joint.friction,
        smooth_rad_s=_smooth_width(joint),
        stribeck_nm=0.0, viscous_power=1.0, load_share=0.0, asymmetry=0.0,
        offset_nm=0.0, elements=(), slip_s=0.0, creep_s=0.0, creep_floor=0.0,
    )  # fmt: skip
    thermal = replace(
        joint.thermal,
        idle_k=0.0, resistance_k_w=0.0, copper_w_a2=0.0, coulomb_per_k=0.0, viscous_per_k=0.0,
    )  # fmt: skip
    return replace(
        joint,
        feedforward_load_share=0.0,
        friction=friction,
        thermal=thermal,
        drive=replace(joint.drive, square_nm_a2=0.0, constant_nm=0.0, ripple_nm=0.0),
        sensor=replace(joint.sensor, moving_a=joint.sensor.rest_a, quantum_a=0.0),
    )


def _smooth_width(joint: JointTruth) -> float:
    """Return the smallest width of the smooth sign that is stable with steps of 1 ms [rad/s]."""
    ideal = ranges()["ideal"]
    per_step = joint.friction.coulomb_nm * 1e-3 / joint.drive.rotor_kgm2
    return max(float(ideal["smooth_rad_s"]), per_step / float(ideal["smooth_steps"]))


def nominal_rotors(arm: ArmDescription) -> list[float]:
    """Return the reflected rotor inertias (n,) as in the manufacturer's data sheet [kg·m²]."""
    column: list[float] = _scaled_table(arm)["rotor_kgm2"].tolist()
    return column
