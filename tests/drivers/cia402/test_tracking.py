"""Axes that do not go where they are told, or not as fast as they say: without drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hil_drivers.cia402.axis import Tracking
from hil_drivers.cia402.bus import Inputs
from hil_drivers.cia402.mapping import LATENCY
from hil_drivers.cia402.supervisor import Phase
from hil_drivers.cia402.torque import GravityComparison
from tests.support.cia402_parts import CSP, CST, PERIOD_S, Rig

RAD = 1e-6
BOUNDS = {CSP: (4.0, "2 × following_error_deg"), CST: (10.0, "tracking_deg")}
N = 2


def increments(degrees: float) -> int:
    return round(math.radians(degrees) / RAD)


def said(
    position: np.ndarray, target: np.ndarray, mode: int = CSP, **more: object
) -> list[tuple[int, str]]:
    """What is said of the second axis by cycle: positions, and the set-points to be reached."""
    tracking = Tracking(PERIOD_S, [RAD, -RAD], BOUNDS, more.get("unit", ()))  # type: ignore[arg-type]
    velocity = more.get("velocity", np.zeros(len(position)))
    inputs, told = Inputs.none_yet(N), []
    inputs.fresh[:] = [True] * N
    sent = np.concatenate((target[LATENCY:], np.repeat(target[-1:], LATENCY)))
    for k in range(len(position)):
        inputs.position[:] = [0, int(position[k])]
        inputs.velocity[:] = [0, int(velocity[k])]  # type: ignore[index]
        told += list(tracking.judge(inputs, [0, int(sent[k])], mode))
    return told


def test_an_axis_that_lags_by_the_latency_of_the_bus_is_where_it_is_to_be() -> None:
    way = increments(3.0) * np.arange(50)  # 750 °/s
    assert said(way, way) == []


@pytest.mark.parametrize(("mode", "bound"), [(CSP, "4°"), (CST, "10°")])
def test_an_axis_that_is_too_far_away_is_named_with_the_figures(mode: int, bound: str) -> None:
    target = np.zeros(50)
    for degrees, wrong in ((float(bound[:-1]) - 0.2, False), (float(bound[:-1]) + 0.3, True)):
        told = said(target + increments(degrees), target, mode)
        assert bool(told) is wrong
    assert {axis for axis, _ in told} == {1}
    assert f"is {degrees:.1f}° from its set-point, the limit is {bound}" in told[0][1]


def test_one_answer_that_is_off_is_let_pass() -> None:
    position = np.zeros(50)
    position[20:22] = increments(90.0)
    assert said(position, np.zeros(50)) == []


@pytest.mark.parametrize("factor", [-1.0, 60.0, 1 / 60.0, 0.0])
def test_a_velocity_that_is_not_that_of_the_positions_is_told(factor: float) -> None:
    speed = 0.6 if factor < 5.0 else 0.05
    position = np.arange(200) * speed * PERIOD_S / RAD
    velocity = np.full(200, speed / RAD * factor)
    told = said(position, position, unit=[RAD, -RAD], velocity=velocity)
    assert {axis for axis, _ in told} == {1}
    assert "axes.velocity_unit or polarity (607Eh) is wrong" in told[0][1]


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.3])
def test_a_velocity_that_agrees_roughly_is_believed(factor: float) -> None:
    position = 1.0 / RAD * np.sin(np.arange(600) * PERIOD_S * 4)
    velocity = 4.0 / RAD * np.cos(np.arange(600) * PERIOD_S * 4) * factor
    assert said(position, position, unit=[RAD, -RAD], velocity=velocity) == []


def test_an_axis_that_runs_away_stops_all_axes() -> None:
    rig = Rig(tracking=Tracking(PERIOD_S, [RAD] * 3, BOUNDS))
    rig.enable()
    for _ in range(50):
        rig.drives[1].position += increments(0.5)
        rig.cycles()
        if rig.phase is not Phase.ENABLED:
            break
    assert rig.outputs.controlword == [0x02] * 3
    assert "axis 2 (node 12): is 5" in rig.problem()


def weighed(measured: list[float]) -> GravityComparison:
    most = np.array([330.0, 420.0, 330.0])
    return GravityComparison(
        np.array(measured), np.array([0.0, -150.0, 60.0]), most, ("a", "b", "c")
    )


def test_torque_that_holds_the_arm_within_friction_is_believed() -> None:
    assert weighed([300.0, -150.0, 60.0]).compared == [1, 2]
    assert weighed([300.0, -120.0, 40.0]).contradictions == []
    assert weighed([0.0, -190.0, 90.0]).contradictions == []


@pytest.mark.parametrize(
    ("measured", "what"), [(150.0, "sign"), (-1500.0, "scale"), (0.0, "scale")]
)
def test_torque_that_cannot_hold_the_arm_is_told_with_the_figures(
    measured: float, what: str
) -> None:
    (told,) = weighed([0.0, measured, 60.0]).contradictions
    assert told == (
        f"b measures {measured:.1f} N·m, but gravity needs -150.0 N·m: "
        f"the {what} of torque is wrong"
    )
