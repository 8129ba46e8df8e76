"""The parts of `hil bench mock_identification`: its truth, its recordings, its verdicts."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.dynamics import base_parameters, load_model
from hil_mock_robot.plant.model import build_plant
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import draw_truth
from tests.support.paths import ROOT
from tests.support.synthetic_motion import moving, nominal


class Parts(NamedTuple):
    truth: Any
    recording: Any
    coverage: Any
    gap: Any


@pytest.fixture(scope="module")
def parts() -> Iterator[Parts]:
    """The benchmark's modules, as its own processes import them."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.identification import mock_coverage, mock_gap, mock_recording, mock_truth

    yield Parts(mock_truth, mock_recording, mock_coverage, mock_gap)
    sys.path.remove(str(ROOT))
    for name in [name for name in sys.modules if name.startswith("benchmarks")]:
        del sys.modules[name]


@pytest.mark.parametrize("arm", ["ur5", "lab6"])
def test_true_parameters_give_the_torques_of_the_mocks_own_physics(parts: Parts, arm: str) -> None:
    truth, robot = draw_truth(arm, 5), load_model(arm)
    rotors = [joint.drive.rotor_kgm2 for joint in truth.joints]
    plant = build_plant(load_arm(arm).dh, truth.links, rotors, Payload(), (0, 0, -9.81), 1e-3)
    motion = np.random.default_rng(0).uniform(-3.0, 3.0, (3, 20, 6))
    by_mujoco = [plant.inverse(*sample) for sample in zip(*motion, strict=True)]
    base = base_parameters(robot, rotor=True)
    columns = base.reduce(robot.regressor(*motion))
    true = parts.truth.true_coefficients(truth, base)[: base.rank]
    assert (columns @ true).reshape(-1, 6) == pytest.approx(np.array(by_mujoco), abs=1e-6)


def test_the_recording_is_the_true_current_and_the_sensors_noise(parts: Parts) -> None:
    truth, series = draw_truth("ur5", 5, "ideal"), parts.recording.trajectories("ur5", 1)
    simulation = Simulation(truth, Setting(500.0), series[0].q_start)
    run = parts.recording.recorded(truth, simulation, series)
    noise = np.std(run.data["effort"] - run.clean, axis=0)
    assert noise == pytest.approx([joint.sensor.rest_a for joint in truth.joints], rel=0.05)
    assert len(run.data) == 5000


def test_effort_is_brought_forward_to_its_state(parts: Parts) -> None:
    data = moving(1)
    late = data.with_columns(effort=np.repeat(np.sin(data["t"] - 0.004)[:, None], 6, axis=1))
    found = parts.recording.advanced(late, 0.004)["effort"][:-1]
    assert found == pytest.approx(np.sin(data["t"])[:-1, None] * np.ones(6), abs=1e-4)


@pytest.mark.thorough
def test_a_current_is_half_a_servo_cycle_and_half_a_step_old(parts: Parts) -> None:
    truth, series = draw_truth("ur5", 5, "ideal"), parts.recording.trajectories("ur5", 1)
    silent = {"rest_a": 0.0, "moving_a": 0.0, "q_rad": 0.0, "qd_rad_s": 0.0, "qd_rest_rad_s": 0.0}
    joints = tuple(replace(j, sensor=replace(j.sensor, **silent)) for j in truth.joints)
    truth = replace(truth, joints=joints)
    simulation = Simulation(truth, Setting(1000.0, 8000.0), series[0].q_start)
    data = parts.recording.recorded(truth, simulation, series).data
    robot, t, qd = load_model("ur5"), data["t"], data["qd"]
    base = base_parameters(robot, rotor=True)
    true = parts.truth.true_coefficients(truth, base)
    columns = base.reduce(robot.regressor(data["q"], qd, np.gradient(qd, t, axis=0)))
    torque = (columns @ true[: base.rank]).reshape(-1, 6)
    coulomb, viscous, _ = true[base.rank :].reshape(6, 3).T
    torque += coulomb * np.tanh(qd / parts.truth.sign_widths(truth)) + viscous * qd
    slope = np.where(np.abs(qd) > 0.2, np.gradient(torque, t, axis=0), 0.0)
    rest = data["effort"] * parts.truth.true_gains(truth) - torque
    late = -np.sum(rest * slope) / np.sum(slope**2)
    assert late == pytest.approx(parts.recording.delay_s(simulation), abs=1e-4)


def test_parameters_are_told_apart_by_what_they_are_of(parts: Parts) -> None:
    names = ("my_2 - m_3", "Ia_4", "Izz_1 + Iyy_2", "J1.coulomb", "J1.viscous", "J1.offset")
    found = {kind: list(rows) for kind, rows in parts.coverage.groups(names).items()}
    assert found == {
        "moment": [0], "rotor": [1], "inertia": [2], "coulomb": [3], "viscous": [4], "offset": [5]
    }  # fmt: skip


def test_mass_matrices_of_nominal_parameters_are_the_models_own(parts: Parts) -> None:
    robot, q = nominal(), np.random.default_rng(1).uniform(-3, 3, (10, 6))
    found = parts.gap.mass_matrices(robot.parameters(rotor=True), robot, q)
    assert found == pytest.approx(robot.mass_matrix(q), abs=1e-9)


def test_a_mass_below_zero_is_seen(parts: Parts) -> None:
    robot = nominal()
    broken = robot.parameters(rotor=True)
    broken[:10] *= -50.0
    assert parts.gap.least_inertia(broken, robot) < 0


def test_the_share_of_the_gap_is_told_from_the_best_classical_method(parts: Parts) -> None:
    errors = {"ols": 2.0, "irls": 1.0, "diffnea": 0.1, "hysteresis": 0.4, "oracle": 0.0}
    contest = parts.gap.Contest(1, errors, errors, {}, {}, {})
    assert contest.share_of_gap(errors) == pytest.approx(0.6)


def test_coverage_is_counted_over_robots_and_by_group(parts: Parts) -> None:
    one = parts.coverage.Estimate(
        ("Ia_1", "J1.offset"), np.array([2.0, 0.0]), np.array([2.2, 0.1]), np.array([0.1, 0.1]),
        {"hac": np.array([0.0, 1.0]), "clustered": np.array([0.0, 1.0])},
    )  # fmt: skip
    other = replace(one, value=np.array([2.0, 0.1]), covered=dict.fromkeys(one.covered, np.ones(2)))
    told = parts.coverage.figures([one, other])
    assert told["coverage_clustered"] == pytest.approx(0.75)
    assert told["rotor_coverage"] == pytest.approx(0.5)
    assert told["rotor_bias_std_errors"] == pytest.approx(1.0)
    assert told["rotor_bias_percent"] == pytest.approx(5.0)
    assert "offset_bias_percent" not in told
