"""One mock robot in motion: set-points in, true state out, as fast as the processor allows.

The embedded robot, and the servers that speak a real controller's protocol, are shells around this.
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
        values: (N, len(CHANNELS), n).
        fault: 0, or one of the `FAULT_…` codes, which then holds for the last sample.
    """

    values: FloatArray
    fault: int

    def __getitem__(self, channel: str) -> FloatArray:
        """(N, n) of one of `CHANNELS`."""
        return self.values[:, CHANNELS.index(channel), :]

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, slots=True)
class Setting:
    """How a robot is set up and computed.

    Attributes:
        rate_hz: Samples per second.
        substep_hz: Integration steps per second.
        gravity: In the base frame [m/s²].
        temperature_c: Temperature of all joints at the start; the room's when None.
    """

    rate_hz: float
    substep_hz: float = 1000.0
    gravity: tuple[float, float, float] = MOUNTS["table"]
    temperature_c: float | None = None


@dataclass(eq=False)
class Simulation:
    """A robot drawn as `truth`, holding `q` at the start.

    Attributes:
        truth: What the robot is like.
        setting: How it is set up.
        q: (n,) joint position at the start [rad].
        arm: Its published description.
        disturbances: Pushes, torque commands and wear; change their arrays in place.
        samples: Number of samples since it was switched on.
        plant: The rigid body, rebuilt when the payload changes.
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
        """(3, n) position, velocity and acceleration last commanded."""
        return self._setpoint.copy()

    @property
    def position(self) -> FloatArray:
        """(n,) true joint position [rad]."""
        return np.array(self.plant.data.qpos)

    @property
    def speed(self) -> FloatArray:
        """(n,) true joint speed [rad/s]."""
        return np.array(self.plant.data.qvel)

    @property
    def celsius(self) -> FloatArray:
        """(n,) joint temperatures."""
        return np.array(self.joints.states["celsius"])

    @property
    def friction(self) -> FloatArray:
        """(n,) friction torque of the last step [N·m]."""
        return np.array(self.joints.states["friction"])

    @property
    def nominal(self) -> Plant:
        """The arm as its controller believes it to be."""
        return self._nominal

    @property
    def moment_target(self) -> FloatArray:
        """(n,) torque of the last set-point by the nominal model, friction excluded [N·m]."""
        return np.array(self._views.nominal_torque)

    def set_payloads(self, mounted: Payload, declared: Payload) -> None:
        """Mount one load, and let the controller compute with another (usually the same) one."""
        self._load(mounted, declared, self.position, self.speed)

    def track(self, position: FloatArray, speed: FloatArray) -> None:
        """Make a state (n,), (n,) the set-point; used around torque control."""
        self._setpoint[:] = position, speed, np.zeros_like(speed)

    def engage_brakes(self) -> None:
        """Freeze the arm where it is and reset the integrators of the servo."""
        self.plant.data.qvel[:] = 0.0
        for held in ("integral", "overload_s"):
            self.joints.states[held] = 0.0
        self.track(self.position, self.speed)

    def advance(self, setpoints: FloatArray) -> Samples:
        """Follow `setpoints` (N, 3, n), one per sample.

        Fewer than N samples come back when the last of them has a fault.
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
        """Let `count` samples pass with the brakes engaged: nothing moves, no current flows."""
        values = np.zeros((count, len(CHANNELS), self.arm.n_joints))
        values[:, CHANNELS.index("q")] = self.position
        values[:, CHANNELS.index("celsius")] = self.celsius
        self.samples += count
        return Samples(values, 0)

    def settle(self, seconds: float = 1.0) -> None:
        """Hold the set-point until the arm has sagged into its servo; costs no samples."""
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
        """Build both models anew and put the arm into a state (n,), (n,)."""
        self.plant = build_plant(
            self.arm.dh, self.truth.links, self.joints.rotors.tolist(), mounted,
            self.setting.gravity, self._timing.dt,
        )  # fmt: skip
        self.plant.data.qpos[:], self.plant.data.qvel[:] = q, v
        if declared != self._believed:
            self._nominal, self._believed = self._build_nominal(declared), declared
        self._attach()

    def _build_nominal(self, payload: Payload) -> Plant:
        """The arm as its controller believes it to be."""
        links, rotors = nominal_links(self.arm), nominal_rotors(self.arm)
        gravity, dt = self.setting.gravity, self._timing.dt
        return build_plant(self.arm.dh, links, rotors, payload, gravity, dt)

    def _attach(self) -> None:
        """Point the compiled step at the present models."""
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
