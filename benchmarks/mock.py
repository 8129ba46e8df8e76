"""The embedded mock: how many times faster than real time, and whether its steps are small enough.

Everything is CPU time on one core, reading included; the peer does the same physics in a plain
Python loop over numpy, in the same run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from hil.core.typing import FloatArray
from hil.robot import Segment
from hil_mock_robot.embedded.robot import MockRobot
from hil_mock_robot.plant.truth import draw_truth

SEED = 7
DT = 1e-3
UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
POSES, QUICK_POSES = 60, 8
PYTHON_S, QUICK_PYTHON_S = 4.0, 0.5
START = "from hil_mock_robot.embedded.robot import MockRobot; MockRobot('b').connect()"


def run(quick: bool = False) -> dict[str, Any]:
    """Measure the mock on a dwell program with all effects on.

    Args:
        quick: Fewer poses, a shorter peer loop, and no cold start.
    """
    path = dwell_path(QUICK_POSES if quick else POSES)
    coarse, coarse_s = _drive(path, 1000.0)
    fine, fine_s = _drive(path, 4000.0)
    seconds = len(path) / 125
    python = python_factor(QUICK_PYTHON_S if quick else PYTHON_S)
    figures = {
        "simulated_s": seconds,
        "realtime_1khz": seconds / coarse_s,
        "realtime_4khz": seconds / fine_s,
        "realtime_1khz_python_numpy": python,
        "difference_1khz_4khz_per_noise": _difference(path),
        "warm_start_s": _start_seconds(None),
    }
    if not quick:
        with tempfile.TemporaryDirectory() as empty:
            figures["cold_start_s"] = _start_seconds(empty)
    ratios = {
        "compiled_vs_python_numpy": seconds / coarse_s / python,
        "peak_tracking_rad_4khz_vs_1khz": _peak_error(fine) / _peak_error(coarse),
    }
    return {"name": "mock", "figures": figures, "ratios": ratios}


def dwell_path(poses: int) -> FloatArray:
    """(N, 3, 6) random moves at up to 60 °/s, each followed by 0.3 s of rest, at 125 Hz."""
    rng, at, parts = np.random.default_rng(SEED), UPRIGHT, []
    for _ in range(poses):
        goal = UPRIGHT + rng.uniform(-1.2, 1.2, 6)
        duration = 1.875 * np.abs(goal - at).max() / np.radians(60)
        s = np.linspace(0, 1, int(duration * 125) + 2)[:, None]
        q = at + (goal - at) * s**3 * (10 - 15 * s + 6 * s**2)
        qd = (goal - at) * 30 * s**2 * (1 - s) ** 2 / duration
        qdd = (goal - at) * 60 * s * (1 - s) * (1 - 2 * s) / duration**2
        move = np.stack((q, qd, qdd), axis=1)
        parts += [move, np.repeat(move[-1:], 37, axis=0)]
        at = goal
    return np.concatenate(parts)


def _drive(path: FloatArray, substep_hz: float) -> tuple[Any, float]:
    """Play a path through the driver; returns its rows and the CPU seconds of prepare and read."""
    robot = MockRobot("bench", seed=SEED, substep_hz=substep_hz)
    robot.connect()
    q, qd, qdd = (np.ascontiguousarray(path[:, k]) for k in range(3))
    start = time.process_time()
    robot.prepare(Segment(0, "trajectory", q, qd, qdd, 1.05, 1.4))
    robot.start()
    blocks, left = [], len(path)
    while left:
        blocks.append(robot.read())
        left -= len(blocks[-1])
    return np.concatenate(blocks), time.process_time() - start


def _peak_error(rows: Any) -> float:
    return float(np.abs(rows["q"] - rows["q_target"]).max())


def _difference(path: FloatArray) -> float:
    """Largest RMS difference of 1 kHz to 4 kHz true currents, per standstill noise of the joint."""
    from hil_mock_robot.plant.simulation import Setting, Simulation

    truth, currents = draw_truth("ur5", SEED), []
    for substep_hz in (1000.0, 4000.0):
        simulation = Simulation(truth, Setting(125.0, substep_hz), UPRIGHT.copy())
        simulation.settle()
        currents.append(simulation.advance(path)["current"])
    noise = np.array([joint.sensor.rest_a for joint in truth.joints])
    rms = np.sqrt(np.mean((currents[0] - currents[1]) ** 2, axis=0))
    return float((rms / noise).max())


def _start_seconds(cache: str | None) -> float:
    """Wall seconds of a process that connects a mock; with an empty `cache` it compiles first."""
    environment = dict(os.environ)
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = cache
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", START], env=environment, check=True)
    return time.perf_counter() - start


def python_factor(seconds: float) -> float:
    """Real-time factor of the same plant, friction and servo in Python over numpy at 1 kHz."""
    loop = _PythonLoop()
    start = time.process_time()
    for _ in range(round(seconds * 1000)):
        loop.step(UPRIGHT)
    return seconds / (time.process_time() - start)


class _PythonLoop:
    """One integration step per call: MuJoCo's bindings, everything else vectorised over joints."""

    def __init__(self) -> None:
        import mujoco

        from hil_mock_robot.plant.simulation import Setting, Simulation

        self._mujoco = mujoco
        arm = Simulation(draw_truth("ur5", SEED), Setting(125.0), UPRIGHT.copy())
        self._plant, joints = arm.plant, arm.joints
        self._laws, self._servos = (
            {name: records[name].copy() for name in records.dtype.fields or {}}
            for records in (joints.laws, joints.servos)
        )
        self._shares, self._stiffness = joints.shares, joints.stiffness
        self._forces, self._rotors = joints.forces.copy(), joints.rotors
        self._celsius = arm.celsius
        n = len(self._rotors)
        self._integral, self._torque, self._friction = np.zeros(n), np.zeros(n), np.zeros(n)

    def step(self, q_target: FloatArray) -> None:
        model, data = self._plant.model, self._plant.data
        self._mujoco.mj_step1(model, data)
        servo, error = self._servos, q_target - data.qpos
        self._integral += servo["integral"] * error * DT
        wanted = servo["stiffness"] * error - servo["damping"] * data.qvel + self._integral
        current = np.clip(wanted, -servo["limit"], servo["limit"]) / servo["gain"]
        load = self._torque - self._friction - self._rotors * data.qacc
        self._friction = self._friction_torque(data.qpos, data.qvel, load)
        self._torque = (
            servo["true_square"] * np.abs(current) * current
            + servo["true_gain"] * current
            + servo["true_constant"]
        )
        data.qfrc_applied[:] = self._torque - self._friction
        self._mujoco.mj_step2(model, data)

    def _friction_torque(self, q: FloatArray, v: FloatArray, load: FloatArray) -> FloatArray:
        law = self._laws
        above = self._celsius - law["reference_c"]
        limit = law["coulomb"] * (1 + law["coulomb_per_k"] * above)
        limit = limit + law["load_share"] * np.abs(load)
        ratio = np.abs(v) / law["stribeck_speed"]
        limit += law["stribeck"] * np.exp(-(ratio ** law["stribeck_shape"]))
        dry = self._elements(v, limit)
        wet = law["viscous"] * (1 + law["viscous_per_k"] * above)
        wet = wet * v * (v * v + 4e-6) ** (0.5 * (law["viscous_power"] - 1))
        wet *= 1 + law["asymmetry"] * np.sign(v)
        ripple = law["ripple"] * np.sin(law["ripple_per_turn"] * q + law["ripple_phase"])
        return np.asarray(dry + wet + law["offset"] + ripple)

    def _elements(self, v: FloatArray, limit: FloatArray) -> FloatArray:
        law, before = self._laws, np.abs(self._forces)
        force = self._forces + self._stiffness * (v * DT)[:, None]
        sign = np.sign(force)
        bound = self._shares * limit[:, None] * (1 + law["asymmetry"][:, None] * sign)
        followed = before + (bound - before) * law["slip_follow"][:, None]
        size = np.abs(force)
        size = np.where(size > bound, np.maximum(bound, np.minimum(size, followed)), size)
        creep = (DT / law["creep_s"] / (1 + (v / 2e-3) ** 2))[:, None]
        floor = law["creep_floor"][:, None] * bound
        size -= np.maximum(size - floor, 0.0) * creep
        self._forces = sign * size
        return np.asarray(self._forces.sum(axis=1))
