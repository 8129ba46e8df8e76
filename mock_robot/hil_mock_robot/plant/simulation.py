"""Simulation of one mock robot: set-points in, true state out, as fast as the processor allows.

The embedded robot and the servers with a real controller's protocol use this simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.friction import friction_laws, slip_elements
from hil_mock_robot.plant.model import Plant, build_plant, nominal_links
from hil_mock_robot.plant.native import address_of
from hil_mock_robot.plant.records import (
    HEAT,
    MOUNTS,
    STATE,
    Disturbances,
    Joints,
    Native,
    Room,
    Views,
    timing_of,
)
from hil_mock_robot.plant.servo import COMMANDS, servo_laws
from hil_mock_robot.plant.step import CHANNELS, simulate
from hil_mock_robot.plant.truth import Truth, nominal_rotors, published


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """True state at the end of each sample; see `CHANNELS` for the order of `values`.

    Attributes:
        values: (N, len(CHANNELS), n) true state.
        fault: Fault at the last sample: 0, or one of the `FAULT_…` codes.
    """

    values: FloatArray
    fault: int

    def __getitem__(self, channel: str) -> FloatArray:
        """Return the values (N, n) of one of `CHANNELS`."""
        return self.values[:, CHANNELS.index(channel), :]

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, slots=True)
class Setting:
    """Set-up and numerical settings of a robot.

    Attributes:
        rate_hz: Number of samples per second.
        substep_hz: Number of integration steps per second.
        gravity: Gravity in the base frame [m/s²].
        temperature_c: Initial temperature of all joints [°C]; None for the room temperature.
    """

    rate_hz: float
    substep_hz: float = 1000.0
    gravity: tuple[float, float, float] = MOUNTS["table"]
    temperature_c: float | None = None


@dataclass(eq=False)
class Simulation:
    """Simulation of the robot `truth`, which initially holds the position `q`.

    Attributes:
        truth: True parameters of the robot.
        setting: Set-up of the robot.
        q: (n,) initial joint position [rad].
        arm: Published description of the arm.
        disturbances: External torques, torque commands and wear; the arrays may be changed in
            place.
        samples: Number of samples since power-on.
        plant: Rigid-body model, rebuilt when the payload changes.
        joints: Parameters and state of friction, drives and servo.
    """

    truth: Truth
    setting: Setting
    q: FloatArray
    arm: ArmDescription = field(init=False)
    disturbances: Disturbances = field(init=False)
    samples: int = field(default=0, init=False)
    plant: Plant = field(init=False)
    joints: Joints = field(init=False)

    def __post_init__(self) -> None:
        self.arm = published(self.truth.arm)
        self._timing = timing_of(self.setting.rate_hz, self.setting.substep_hz)
        n = self.arm.n_joints
        self.disturbances = Disturbances(np.zeros(n), np.full(n, np.nan), np.ones(n))
        self.joints = self._build_joints()
        self._setpoint = np.zeros((COMMANDS, n))
        self._setpoint[0] = self.q
        self._believed: Payload | None = None
        self._load(Payload(), Payload(), self.q, np.zeros(n))

    @property
    def setpoint(self) -> FloatArray:
        """Last commanded position, velocity and acceleration, (3, n)."""
        return self._setpoint.copy()

    @property
    def position(self) -> FloatArray:
        """True joint position (n,) [rad]."""
        return np.array(self.plant.data.qpos)

    @property
    def speed(self) -> FloatArray:
        """True joint speed (n,) [rad/s]."""
        return np.array(self.plant.data.qvel)

    @property
    def celsius(self) -> FloatArray:
        """Joint temperatures (n,) [°C]."""
        return np.array(self.joints.states["celsius"])

    @property
    def friction(self) -> FloatArray:
        """Friction torque of the last step (n,) [N·m]."""
        return np.array(self.joints.states["friction"])

    @property
    def nominal(self) -> Plant:
        """Model of the arm in its controller."""
        return self._nominal

    @property
    def moment_target(self) -> FloatArray:
        """Torque of the last set-point in the nominal model, without friction, (n,) [N·m]."""
        return np.array(self._views.nominal_torque)

    def set_payloads(self, mounted: Payload, declared: Payload) -> None:
        """Set the mounted payload and the (usually identical) payload of the controller's model."""
        self._load(mounted, declared, self.position, self.speed)

    def track(self, position: FloatArray, speed: FloatArray) -> None:
        """Set position (n,) and speed (n,) as the set-point, before and after torque control."""
        self._setpoint[:] = position, speed, np.zeros_like(speed)

    def engage_brakes(self) -> None:
        """Stop the arm instantly at its position, and reset the integrators of the servo."""
        self.plant.data.qvel[:] = 0.0
        for held in ("integral", "overload_s"):
            self.joints.states[held] = 0.0
        self.track(self.position, self.speed)

    def advance(self, setpoints: FloatArray) -> Samples:
        """Follow `setpoints` (N, 3, n), one per sample.

        If a fault occurs, fewer than N samples are returned, and the last of them has the fault.
        """
        path = np.concatenate((self._setpoint[None], setpoints))
        values = np.zeros((len(setpoints), len(CHANNELS), self.arm.n_joints))
        done, fault = simulate(
            self._native, self._views, self.joints, self.disturbances, self._timing,
            self._room, self.samples, path, values,
        )  # fmt: skip
        self.samples += done
        self._setpoint = path[done].copy()
        return Samples(values[:done], fault)

    def stand(self, count: int) -> Samples:
        """Advance `count` samples with the brakes engaged, without motion and without current."""
        values = np.zeros((count, len(CHANNELS), self.arm.n_joints))
        values[:, CHANNELS.index("q")] = self.position
        values[:, CHANNELS.index("celsius")] = self.celsius
        self.samples += count
        return Samples(values, 0)

    def settle(self, seconds: float = 1.0) -> None:
        """Hold the set-point until the servo is in equilibrium; reset samples and temperatures."""
        rows = round(seconds * self.setting.rate_hz)
        celsius = self.celsius
        self.advance(np.repeat(self._setpoint[None], rows, axis=0))
        self.joints.states["celsius"] = celsius
        self.samples = 0

    def _build_joints(self) -> Joints:
        truth, n = self.truth, self.arm.n_joints
        shares, stiffness = slip_elements(truth)
        rotors = np.array([joint.drive.rotor_kgm2 for joint in truth.joints])
        heats = [
            (t.idle_k, t.resistance_k_w, t.copper_w_a2, t.tau_s)
            for t in (joint.thermal for joint in truth.joints)
        ]
        states = np.zeros(n, dtype=STATE)
        start = self.setting.temperature_c
        states["celsius"] = truth.ambient_c if start is None else start
        return Joints(
            laws=friction_laws(truth, self._timing.dt),
            servos=servo_laws(self.arm, truth, self._build_nominal(Payload())),
            heats=np.array(heats, dtype=HEAT),
            states=states,
            shares=shares,
            stiffness=stiffness,
            forces=np.zeros_like(shares),
            rotors=rotors,
        )

    def _load(self, mounted: Payload, declared: Payload, q: FloatArray, v: FloatArray) -> None:
        """Rebuild both models and set the state of the arm: position (n,) and speed (n,)."""
        self.plant = build_plant(
            self.arm.dh, self.truth.links, self.joints.rotors.tolist(), mounted,
            self.setting.gravity, self._timing.dt,
        )  # fmt: skip
        self.plant.data.qpos[:], self.plant.data.qvel[:] = q, v
        if declared != self._believed:
            self._nominal, self._believed = self._build_nominal(declared), declared
        self._attach()

    def _build_nominal(self, payload: Payload) -> Plant:
        """Return the model of the arm in its controller."""
        links, rotors = nominal_links(self.arm), nominal_rotors(self.arm)
        gravity, dt = self.setting.gravity, self._timing.dt
        return build_plant(self.arm.dh, links, rotors, payload, gravity, dt)

    def _attach(self) -> None:
        """Pass the current models to the compiled step."""
        plant, nominal = self.plant, self._nominal
        truth = self.truth
        self._native = Native(
            address_of("mj_step1"), address_of("mj_step2"), address_of("mj_inverse"),
            *plant.addresses, *nominal.addresses,
        )  # fmt: skip
        self._views = _views_of(plant, nominal)
        self._room = Room(
            truth.ambient_c,
            truth.ambient_swing_k,
            2 * np.pi / truth.ambient_period_s,
            truth.ambient_phase_rad,
        )
        at = self._nominal.inverse(*self._setpoint)
        self.joints.states["feedforward_1"] = at


def _views_of(plant: Plant, nominal: Plant) -> Views:
    state, model = plant.data, nominal.data
    return Views(
        state.qpos, state.qvel, state.qacc, state.qfrc_applied,
        model.qpos, model.qvel, model.qacc, model.qfrc_inverse,
    )  # fmt: skip
