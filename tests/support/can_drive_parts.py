"""Mock drives without a bus: one on a joint that does at once what it is told, six on the plant."""

from __future__ import annotations

import math

import numpy as np

from hil.arms import load_arm
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import joints_of
from hil_mock_robot.cia402.body import STEP_S, Body, Demand, Measured
from hil_mock_robot.cia402.dictionary import increments_per_rad, registers_of
from hil_mock_robot.cia402.drive import Drive
from hil_mock_robot.cia402.power import State
from hil_mock_robot.plant.truth import draw_truth

ARM = load_arm("lab6")
STEPS = 4
"""Per SYNC: 60C2h as the drives have it after power-on."""

PP, HM, CSP, CSV, CST = 1, 6, 8, 9, 10

FASTEST_RAD_S = 10.0
"""What a motor reaches without a load, whatever its torque."""


class OneDrive:
    """A drive on a joint without dynamics: it follows set-points, and turns freely by torque."""

    def __init__(self, joint: int = 1, inertia: float = 5.0) -> None:
        self.registers = registers_of(ARM, joint)
        self.emergencies: list[tuple[int, int]] = []
        self.drive = Drive(
            self.registers,
            joints_of(ARM)[joint],
            lambda code, register: self.emergencies.append((code, register)),
        )
        self.counts = increments_per_rad(ARM, joint)
        self.inertia = inertia
        self.q, self.qd, self.celsius = 0.3, 0.0, 30.0
        self.lag = 0.0
        """How far the joint stays behind its set-point [rad]."""
        self.limited = False
        self.demands: list[Demand] = []
        self.speeds: list[float] = []

    def on(self) -> OneDrive:
        """Switch it on."""
        self.drive.measured(self._measured(0.0))
        return self

    def enabled(self, mode: int = CSP) -> OneDrive:
        """All the way up, in a mode, with its target where it is."""
        self.on()
        self.set(keys.MODE, mode)
        self.set(keys.TARGET_POSITION, self.registers[keys.POSITION])
        for word in (0x06, 0x07, 0x0F):
            self.tell(word)
        assert self.state is State.OPERATION_ENABLED
        self.speeds.clear()
        return self

    def moving(self, speed: float, mode: int = CSV) -> OneDrive:
        """Enabled, and turning at a speed [rad/s]."""
        self.enabled(mode)
        self.set(keys.TARGET_VELOCITY, round(speed * self.counts))
        self.cycles(5)
        assert self.qd == speed or mode != CSV or abs(self.qd - speed) < 1e-6
        return self

    @property
    def state(self) -> State:
        return self.drive.state

    @property
    def status(self) -> int:
        return self.registers[keys.STATUSWORD]

    def set(self, where: int, value: int) -> None:
        """As an SDO client does it."""
        self.registers[where] = value
        self.drive.written(where)

    def tell(self, word: int, cycles: int = 1) -> None:
        """As an RPDO does it: the controlword is there at the next SYNC."""
        self.registers[keys.CONTROLWORD] = word
        self.cycles(cycles)

    def cycles(self, count: int, *, synced: bool = True, steps: int = STEPS) -> Demand:
        """Let SYNCs pass, or the drives' own timer."""
        for _ in range(count):
            demand = self.drive.advance(steps, synced=synced)
            assert demand.setpoints.shape == (steps, 3)
            self.demands.append(demand)
            self._obey(demand, steps)
            torque = 0.0 if math.isnan(demand.torque) else demand.torque
            self.drive.measured(self._measured(torque), steps)
        return self.demands[-1]

    def until(self, state: State, most: int = 2000) -> int:
        """Let SYNCs pass until it is in a state; how many."""
        for count in range(most):
            if self.state is state:
                return count
            self.cycles(1)
        raise AssertionError(f"{self.state} after {most} cycles, not {state}")

    def _obey(self, demand: Demand, steps: int) -> None:
        if demand.braked:
            self.qd = 0.0
        elif math.isnan(demand.torque):
            q, self.qd, _ = demand.setpoints[-1].tolist()
            self.q = q - self.lag
            self.speeds.extend(demand.setpoints[:, 1].tolist())
        else:
            faster = self.qd + demand.torque / self.inertia * steps * STEP_S
            self.qd = min(max(faster, -FASTEST_RAD_S), FASTEST_RAD_S)
            self.q += self.qd * steps * STEP_S

    def _measured(self, torque: float) -> Measured:
        gain = float(ARM.drive_gains[1])
        return Measured(
            self.q, self.qd, torque, torque / gain, self.celsius, self.q, self.qd, self.limited
        )


class SixDrives:
    """Six drives on the plant, told all at once."""

    def __init__(self, q: object = None, seed: int = 0, **options: object) -> None:
        start = np.zeros(6) if q is None else np.asarray(q, dtype=float)
        self.body = Body(draw_truth("lab6", seed), start, **options)  # type: ignore[arg-type]
        self.steps = STEPS
        self.emergencies: list[tuple[int, int]] = []
        self.registers = [registers_of(ARM, j) for j in range(6)]
        self.counts = np.array([increments_per_rad(ARM, j) for j in range(6)])
        self.drives = [
            Drive(self.registers[j], joint, lambda code, _, j=j: self.emergencies.append((j, code)))
            for j, joint in enumerate(joints_of(ARM))
        ]
        for drive, seen in zip(self.drives, self.body.seen, strict=True):
            drive.measured(seen)

    def enabled(self, mode: int = CSP) -> SixDrives:
        """All of them, where they are."""
        self.set(keys.MODE, [mode] * 6)
        self.set(keys.TARGET_POSITION, self.raw(keys.POSITION))
        for word in (0x06, 0x07, 0x0F):
            self.tell(word)
        return self

    def raw(self, where: int) -> list[int]:
        """(6,) of an object."""
        return [registers[where] for registers in self.registers]

    def set(self, where: int, values: object) -> None:
        """An object of all drives."""
        for registers, value in zip(self.registers, np.asarray(values).tolist(), strict=True):
            registers[where] = value

    def tell(self, word: int, cycles: int = 1) -> None:
        """Controlword of all."""
        self.set(keys.CONTROLWORD, [word] * 6)
        self.cycles(cycles)

    def aim(self, q: object) -> None:
        """CSP targets [rad]."""
        self.set(keys.TARGET_POSITION, np.round(np.asarray(q) * self.counts).astype(int))

    def cycles(self, count: int, *, synced: bool = True) -> None:
        """Let SYNCs pass."""
        for _ in range(count):
            demands = [drive.advance(self.steps, synced=synced) for drive in self.drives]
            for drive, seen in zip(self.drives, self.body.advance(demands), strict=True):
                drive.measured(seen, self.steps)
            for axis, code in self.body.faults.items():
                self.drives[axis].fault(code)

    @property
    def q(self) -> np.ndarray:
        """(6,) true position [rad]."""
        return np.array([seen.true_q for seen in self.body.seen])

    @property
    def qd(self) -> np.ndarray:
        """(6,) true speed [rad/s]."""
        return np.array([seen.true_qd for seen in self.body.seen])

    @property
    def states(self) -> set[State]:
        return {drive.state for drive in self.drives}
