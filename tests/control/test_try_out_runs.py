"""Runs of a trial are fair to what the model is compared with, and safe for whoever leads."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.control import try_out
from hil.control.controllers import Spring, spring_for
from hil.control.hand_guiding import HandGuiding
from hil.control.try_out import (
    HAND_FIRMNESS,
    Arm,
    Leading,
    lead,
    relief,
    require_simulated,
    spec_of,
)
from hil.control.try_out_settings import FRICTION_SHARE, HALF, RATE_HZ
from hil.core import plugins
from hil.core.errors import SpecError
from hil.planning.build import build_plan
from hil.spec.station import StationRobot
from tests.support.trial_parts import bench, model, reference, way


class RealArm:
    """A driver with methods of the right names, which could turn a real arm."""

    def command_torque(self, torque):
        raise AssertionError("a real arm was driven by torque")

    push = command_torque


@pytest.mark.parametrize("said", [None, False, 1, "yes"])
def test_methods_of_the_right_names_make_no_simulated_arm(said, monkeypatch) -> None:
    driver = type("Driver", (RealArm,), {} if said is None else {"simulated": said})
    monkeypatch.setattr(plugins, "load", lambda group, name: driver)
    with pytest.raises(SpecError, match="does not declare itself a simulated arm"):
        require_simulated("real", StationRobot(driver="ur", model="ur5"))
    robot = driver()
    robot.identity = SimpleNamespace(model="ur5")
    with pytest.raises(SpecError, match="no simulated arm"):
        Arm(robot)


@pytest.mark.thorough
def test_every_law_has_the_same_controller_and_every_way_the_same_hand(monkeypatch) -> None:
    given = []

    def track(arm, law, ahead, asked, pd):
        given.append(pd)

    def led(arm, name, drives, asked, hand):
        given.append(hand)

    monkeypatch.setattr(try_out, "track", track)
    monkeypatch.setattr(try_out, "lead", led)
    pd, hand = Spring(np.ones(6), np.ones(6)), Spring(np.ones(6), np.ones(6))
    try_out.tracked_by(model(), bench(), reference(), pd, print)
    assert len(given) == 4
    assert all(one is pd for one in given)
    helped, _ = try_out.guidings(model(), bench(), FRICTION_SHARE)
    given.clear()
    try_out.led_with(helped, model(), bench(), way(), hand, print)
    assert len(given) == 4
    assert all(one is hand for one in given)


def test_the_datasheet_carries_the_arm_too(monkeypatch) -> None:
    given = {}
    monkeypatch.setattr(
        try_out, "lead", lambda arm, name, drives, way, hand: given.update({name: drives})
    )
    load = Payload(2.0, (0.0, 0.0, 0.05))
    loaded = bench()
    loaded = type(loaded)(loaded.name, loaded.robot, load)
    try_out.led_with({}, model(), loaded, way(), Spring(np.ones(6), np.ones(6)), print)
    q = way().start
    true = model().robot_.with_payload(load).gravity(q[None])[0]
    assert given[try_out.DATASHEET](q, np.zeros(6)) == pytest.approx(true)
    assert given[try_out.NOTHING] is None


@pytest.mark.thorough
def test_an_arm_that_strays_from_the_hand_is_braked() -> None:
    asked = iter(range(10**6))

    def runaway(q, qd):
        # More and more, so slowly that no limit of speed is reached.
        return np.array([min(0.05 * next(asked), 150.0), 0, 0, 0, 0, 0])

    with bench().arm(way().start) as arm:
        soft = Spring(np.full(6, 150.0), np.full(6, 20.0))
        run = lead(arm, "runaway", runaway, way(), soft)
    assert run.stopped.startswith("the arm strayed from the hand")
    assert 0.55 < np.abs(run.q - way().start).max() < 0.7
    assert np.isnan(run.rms).all()


def test_trembling_of_the_measured_velocity_does_not_reach_the_drives() -> None:
    guiding = HandGuiding(model(), friction_share=FRICTION_SHARE)
    drives = try_out.in_torque(guiding, SimpleNamespace(gains=np.ones(6)))
    q, still = way().start, np.zeros(6)
    for k in range(200):
        torque = drives(q, np.full(6, 0.1 * (-1) ** k))
    assert torque == pytest.approx(guiding(q, still))
    assert np.abs(guiding(q, np.full(6, 0.1)) - guiding(q, still)).min() > 0.1


@pytest.mark.thorough
@pytest.mark.parametrize("filtered", [True, False])
def test_an_arm_comes_to_rest_behind_the_filter_alone(monkeypatch, filtered) -> None:
    monkeypatch.setattr(try_out, "ALONE_S", 1.5)
    if not filtered:
        monkeypatch.setattr(try_out, "LowPass", lambda cutoff, rate: lambda qd: qd)
    short = Leading(way().start, way().swing, 0.5)
    hand = spring_for(model().robot_, short.start[None]).firmer(HAND_FIRMNESS)
    helped, _ = try_out.guidings(model(), bench(), FRICTION_SHARE)
    with bench().arm(short.start) as arm:
        run = lead(arm, "led", try_out.in_torque(helped[try_out.FRICTION], arm), short, hand)
    assert np.isfinite(run.rest_s) == filtered


@pytest.mark.thorough
def test_a_trial_of_a_seed_is_no_experiment_of_that_seed() -> None:
    ours = spec_of("arm", Payload(), 7)
    theirs = ours.model_copy(update={"excitation": ours.excitation.model_copy(update={"seed": 7})})
    plans = [build_plan(spec, bench().robot, rate_hz=RATE_HZ) for spec in (ours, theirs)]
    motions = [
        next(step.motion.sample(100.0).q for step in plan.steps if step.kind == "trajectory")
        for plan in plans
    ]
    assert motions[0].shape != motions[1].shape or np.abs(motions[0] - motions[1]).max() > 0.1


def test_what_a_static_model_is_not_worth_is_said() -> None:
    static = SimpleNamespace(series_kinds=(("dwell",),), estimator="static-wls")
    assert "all that it gives ahead is gravity" in next(try_out._about(static, "a", "a"))
    assert not list(try_out._about(model(), "a", "a"))


def test_joints_that_are_led_less_far_are_named() -> None:
    short = Leading(way().start, np.radians([20.0, -20, 10, 20, 20, 20]))
    (told,) = try_out._short_ways(short, model().joint_names_)
    assert told.endswith(f"{model().joint_names_[2]} 10°")
    assert not list(
        try_out._short_ways(
            Leading(short.start, np.full(6, np.radians(20.0))), model().joint_names_
        )
    )


@pytest.mark.thorough
def test_a_hand_needs_at_most_half_of_the_effort(monkeypatch) -> None:
    """In three quarters of the time; as `hil try-out` has it in test_trial_proof.py."""
    monkeypatch.setattr(try_out, "ALONE_S", 0.0)
    slow = Leading(way().start, np.full(6, np.radians(20.0)), 3.0)
    hand = spring_for(model().robot_, slow.start[None]).firmer(HAND_FIRMNESS)
    helped, _ = try_out.guidings(model(), bench(), FRICTION_SHARE)
    led = []
    for name in (try_out.NOTHING, try_out.FRICTION):
        with bench().arm(slow.start) as arm:
            drives = try_out.in_torque(helped[name], arm) if name in helped else None
            led.append(lead(arm, name, drives, slow, hand))
    made = SimpleNamespace(led=led, joint_names=model().joint_names_)
    assert np.all(relief(made, try_out.FRICTION, try_out.NOTHING) <= HALF)
