"""Trying a model out by hand guiding on the mock: the trial, its runs, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from hil import api
from hil.arms.payload import Payload
from hil.cli.app import app
from hil.control import controllers, try_out
from hil.control.controllers import Spring, spring_for
from hil.control.hand_guiding import HandGuiding
from hil.control.try_out import (
    HAND_FIRMNESS,
    Arm,
    Leading,
    improvement,
    judged,
    lead,
    leading_for,
    relief,
    require_simulated,
    spec_of,
    track,
    trajectory_for,
    unaided,
)
from hil.control.try_out_report import found
from hil.control.try_out_settings import FRICTION_SHARE, HALF
from hil.core import plugins
from hil.core.errors import HilError, RecordingError, Rejected, SpecError
from hil.dynamics import load_model
from hil.planning.build import build_plan
from hil.report.try_out_page import trial_page
from hil.robot import Capabilities, Identity, TorqueControlled, state_dtype
from hil.spec.station import StationRobot
from hil.studies.result import faults_of
from hil_mock_robot.plant.truth import draw_truth
from tests.support.trial_parts import (
    ELSEWHERE,
    STATION,
    bench,
    model,
    model_folder,
    reference,
    short_trial,
    shorten,
    way,
)

# A model tried on a simulated arm: what is refused, what is measured, and what is said of it


class Recording:
    """A robot that only notes what it is told."""

    simulated = True

    def __init__(self, speed=0.0):
        self.identity = Identity("ur5", "x-1", "", "test")
        self.capabilities = Capabilities(("j",) * 6, 1000.0, "current", (1.0,) * 6)
        self.limits = SimpleNamespace(
            effort_max=load_model("ur5").effort_max, qd_max=np.full(6, 3.0)
        )
        self.told, self.speed = [], speed

    def command_torque(self, torque):
        self.told.append(torque)

    push = command_torque

    def read(self):
        row = np.zeros(1, state_dtype(6))
        row["qd"] = self.speed
        return row


@pytest.fixture
def station(tmp_path):
    path = tmp_path / "station.yaml"
    path.write_text(STATION, "utf-8")
    return path


@pytest.fixture(scope="module")
def trial():
    made, folder = short_trial()
    return made, found(made), trial_page(made), folder / "out"


def test_a_real_robot_is_refused_before_it_is_opened(station) -> None:
    with pytest.raises(SpecError, match="does not declare a simulated arm"):
        require_simulated("real", StationRobot(driver="ur", model="ur5"))


def test_a_robot_in_wall_time_is_refused(station) -> None:
    robot = StationRobot(driver="mock", model="ur5", options={"clock": "wall"})
    with pytest.raises(SpecError, match="wall time"):
        require_simulated("timed", robot)


def test_torque_stays_within_the_limits() -> None:
    robot = Recording()
    assert Arm(robot).step(np.array([1e4, -1e4, 5.0, 0.0, 0.0, 0.0]), np.ones(6))
    torque, push = robot.told
    assert torque.tolist() == [150.0, -150.0, 5.0, 0.0, 0.0, 0.0]
    assert push.tolist() == [1.0] * 6


def test_an_arm_that_is_too_fast_is_braked() -> None:
    robot = Recording(speed=4.0)
    assert not Arm(robot).step(np.zeros(6), np.ones(6))
    push, torque = robot.told[-2:]
    assert torque is None
    assert not push.any()


def test_a_torque_that_is_no_number_brakes_the_arm() -> None:
    with bench().arm(way().start) as arm:
        assert isinstance(arm._robot, TorqueControlled)
        assert not arm.step(np.array([0.0, np.nan, 0, 0, 0, 0]))
        for _ in range(100):
            arm.wait()
        assert arm.q == pytest.approx(way().start, abs=1e-3)


@pytest.mark.thorough
def test_tracking_ends_safely_when_the_arm_strays() -> None:
    asked, still = reference(), np.zeros(6)
    with bench().arm(asked.q[0]) as arm:
        laws_of = controllers.feed_forwards(model(), Payload(), asked, arm.gains)
        pushed = dict(laws_of)[controllers.GRAVITY] + [15.0, 0, 0, 0, 0, 0]
        run = track(arm, "wrong", pushed, asked, Spring(still, still))
    assert run.stopped.startswith("J1 was 20° off")
    assert np.isnan(run.rms).all()


@pytest.mark.thorough
def test_the_model_ahead_is_the_torque_the_true_arm_takes() -> None:
    asked = reference()
    gains = np.array([joint.drive.gain_nm_a for joint in draw_truth("ur5", 5).joints])
    ahead = dict(controllers.feed_forwards(model(), Payload(), asked, gains))
    assert list(ahead) == list(controllers.TOLD)
    assert not ahead[controllers.NOTHING].any()
    rigid = model().robot_.inverse_dynamics(asked.q, asked.qd, asked.qdd)
    assert np.array_equal(ahead[controllers.NOMINAL], rigid)
    at_rest = asked.t < 0
    assert ahead[controllers.MODEL][at_rest] == pytest.approx(
        ahead[controllers.GRAVITY][at_rest], abs=1e-6
    )


@pytest.mark.thorough
def test_a_load_is_part_of_every_law_but_none() -> None:
    asked, gains = reference(), np.ones(6)
    load = Payload(2.0, (0.0, 0.0, 0.05))
    bare = dict(controllers.feed_forwards(model(), Payload(), asked, gains))
    loaded = dict(controllers.feed_forwards(model(), load, asked, gains))
    more = {law: np.abs(loaded[law] - bare[law]).max() for law in controllers.TOLD}
    assert more[controllers.NOTHING] == 0.0
    assert min(more[law] for law in controllers.TOLD if law != controllers.NOTHING) > 0.5


def test_a_network_is_asked_at_the_rate_of_its_training(monkeypatch) -> None:
    asked = reference()
    whole = controllers.predicted(model(), Payload(), asked)
    monkeypatch.setattr("hil.control.controllers.rate_of", lambda model: 125.0)
    slower = controllers.predicted(model(), Payload(), asked)
    assert slower.shape == whole.shape
    assert not np.array_equal(slower, whole)
    assert np.abs(slower - whole)[asked.t < -0.01].max() < 1e-9
    assert np.abs(slower - whole).max() < 10.0


@pytest.mark.thorough
def test_the_hand_carries_an_arm_whose_drives_are_off(monkeypatch) -> None:
    shorten(monkeypatch)
    with bench().arm(way().start) as arm:
        hand = spring_for(model().robot_, way().start[None]).firmer(2.0)
        run = lead(arm, "drives off", None, way(), hand)
    gravity = np.abs(model().robot_.gravity(way().start[None])[0])
    assert run.rms[1] > 0.6 * gravity[1] > 10.0
    assert np.isfinite(run.rest_s)


@pytest.mark.thorough
def test_the_model_tracks_better_and_relieves_the_hand(trial) -> None:
    made, *_ = trial
    assert improvement(made) > 3.0
    assert np.mean(relief(made, try_out.FRICTION, try_out.NOTHING)) < 0.7
    assert np.all(relief(made, try_out.FRICTION, try_out.GRAVITY) < 0.95)
    assert not any(run.stopped for run in (*made.tracked, *made.led))


@pytest.mark.thorough
def test_the_page_and_the_tables_can_be_shown(trial) -> None:
    made, told, page, out = trial
    assert faults_of(told) == []
    assert page.key_figures[0].value.endswith("×")
    assert "plotly" in (out / "report.html").read_text("utf-8")
    document = json.loads((out / "try-out.json").read_text("utf-8"))
    assert [run["law"] for run in document["tracking"]] == list(controllers.TOLD)
    assert len(document["hand"]["led"][3]["rms_nm"]) == 6
    assert document["serial"] == made.serial == "arm-full-5"


@pytest.mark.thorough
def test_an_arm_that_never_rests_is_no_success(trial) -> None:
    made = trial[0]
    restless = replace(made.led[2], rest_s=float("inf"))
    worse = replace(made, led=(*made.led[:2], restless))
    assert trial_page(worse).badge.mark == "fail"
    assert "NOT AT REST with gravity" in found(worse).summary[0]
    assert not worse.ok


@pytest.mark.thorough
def test_a_braked_run_is_said_and_has_no_figures(trial) -> None:
    made = trial[0]
    braked = replace(made.tracked[-1], stopped="J2 was 20° off at 1.00 s")
    worse = replace(made, tracked=(*made.tracked[:-1], braked))
    assert trial_page(worse).badge.mark == "fail"
    assert "BRAKED, model: J2 was 20° off" in found(worse).summary[0]
    assert worse.to_dict()["tracking"][-1]["rms_rad"] == [None] * 6
    assert faults_of(found(worse)) == []


@pytest.mark.thorough
def test_a_braked_run_without_the_model_does_not_speak_against_it(trial) -> None:
    made = trial[0]
    braked = replace(made.tracked[0], stopped="J2 was 20° off at 1.00 s")
    other = replace(made, tracked=(braked, *made.tracked[1:]))
    assert [criterion.met for criterion in judged(other)][:3] == [True] * 3
    assert unaided(other) == controllers.NOMINAL
    assert any(
        "Without the model (no model), the arm was braked" in t for t in found(other).summary
    )


@pytest.mark.thorough
def test_the_motions_keep_clear_and_within_limits() -> None:
    asked = trajectory_for(bench(), seed=3)
    robot = model().robot_
    assert np.all((asked.q > robot.q_min) & (asked.q < robot.q_max))
    assert not np.array_equal(asked.q, trajectory_for(bench(), seed=4).q)
    assert np.all(np.abs(leading_for(bench()).swing) >= np.radians(1.0))


def test_the_hand_moves_one_joint_at_a_time_then_all() -> None:
    led = way()
    assert np.flatnonzero(led.at(0.2)[1]).tolist() == [0]
    assert np.flatnonzero(led.at(led.turns_s - 0.2)[1]).tolist() == [5]
    assert np.all(led.at(led.release_s)[1] > 0)
    step = 1e-6
    slope = (led.at(1.13 + step)[0] - led.at(1.13 - step)[0]) / (2 * step)
    assert led.at(1.13)[1] == pytest.approx(slope, abs=1e-6)


def test_the_command_says_who_cannot_be_tried(station) -> None:
    done = CliRunner().invoke(
        app,
        ["simulate", str(model_folder()), "-o", str(station.parent / "out"), "--station",
         str(station), "--robot", "real"],
    )  # fmt: skip
    assert isinstance(done.exception, SpecError)
    assert "torque is commanded to simulated arms only" in str(done.exception)


# Runs of a trial are fair to what the model is compared with, and safe for whoever leads


class RealArm:
    """A driver with methods of the right names, which could turn a real arm."""

    def command_torque(self, torque):
        raise AssertionError("a real arm was driven by torque")

    push = command_torque


@pytest.mark.parametrize("said", [None, False, 1, "yes"])
def test_methods_of_the_right_names_make_no_simulated_arm(said, monkeypatch) -> None:
    driver = type("Driver", (RealArm,), {} if said is None else {"simulated": said})
    monkeypatch.setattr(plugins, "load", lambda group, name: driver)
    with pytest.raises(SpecError, match="does not declare a simulated arm"):
        require_simulated("real", StationRobot(driver="ur", model="ur5"))
    robot = driver()
    robot.identity = SimpleNamespace(model="ur5")
    with pytest.raises(SpecError, match="is not a simulated arm"):
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
    assert run.stopped.startswith("the arm deviated from the hand")
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
    plans = [build_plan(spec, bench().robot, rate_hz=100.0) for spec in (ours, theirs)]
    motions = [
        next(step.motion.sample(100.0).q for step in plan.steps if step.kind == "trajectory")
        for plan in plans
    ]
    assert motions[0].shape != motions[1].shape or np.abs(motions[0] - motions[1]).max() > 0.1


def test_what_a_static_model_is_not_worth_is_said() -> None:
    static = SimpleNamespace(series_kinds=(("dwell",),), estimator="static-wls")
    assert "torque is gravity only" in next(try_out._about(static, "a", "a"))
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


@pytest.mark.proof
def test_a_hand_needs_at_most_half_of_the_effort(monkeypatch) -> None:
    """In three quarters of the time; as `hil simulate` has it in test_trial_proof.py."""
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


# `hil simulate` on the command line: what it refuses, what it prints, how it ends


@pytest.fixture
def place():
    """Where the station is."""
    return short_trial()[1]


@pytest.fixture
def written_trial():
    """A written_trial whose model meets all it is held to."""
    made, _ = short_trial()
    helped = replace(made.led[-1], effort=0.4 * made.led[0].effort)
    return replace(made, led=(*made.led[:-1], helped), notes=())


@pytest.fixture
def asked(written_trial, monkeypatch):
    """The command line, with a written_trial that is over."""
    ended = [written_trial]
    monkeypatch.setattr("hil.api.simulate", lambda *given, **options: ended[0])
    given = ["simulate", str(model_folder()), "-o", "out"]
    return ended, lambda *more: CliRunner().invoke(app, [*given, *more])


def test_the_page_comes_first_then_a_few_lines(asked) -> None:
    done = asked[1]()
    lines = done.stdout.splitlines()
    assert done.exit_code == 0
    assert lines[0] == "report: out/report.html"
    assert len(lines) < 10
    assert any("at most half in every joint" in line for line in lines)


def test_lines_are_folded_to_the_terminal(asked, monkeypatch) -> None:
    monkeypatch.setattr("hil.cli.output.width_of", lambda stream: 60)
    lines = asked[1]().stdout.splitlines()
    assert max(map(len, lines)) <= 60


def test_json_says_that_all_is_well(asked) -> None:
    document = json.loads(asked[1]("--json").stdout)
    assert document["report"] == "out/report.html"
    assert document["rate_hz"] == 1000.0
    assert document["hand"]["friction_share"] == FRICTION_SHARE
    assert document["ok"] is True
    assert [criterion["met"] for criterion in document["criteria"]] == [True] * 4


def test_an_arm_that_does_not_rest_ends_with_the_code_of_a_bad_result(asked) -> None:
    ended, ask = asked
    restless = replace(ended[0].led[-1], rest_s=float("inf"))
    ended[0] = replace(ended[0], led=(*ended[0].led[:-1], restless))
    done = ask("--json")
    assert isinstance(done.exception, Rejected)
    assert done.exception.exit_code == 10
    assert "reduce --friction-share" in done.exception.hint
    assert json.loads(done.stdout)["ok"] is False


def test_a_hand_that_is_not_relieved_enough_is_a_bad_result(asked) -> None:
    ended, ask = asked
    poor = replace(ended[0].led[-1], effort=0.6 * ended[0].led[0].effort)
    ended[0] = replace(ended[0], led=(*ended[0].led[:-1], poor))
    done = ask()
    assert isinstance(done.exception, Rejected)
    assert "60 60 60 60 60 60 % (mean 60 %): at most half in no joint" in done.stdout


@pytest.mark.parametrize(
    "more",
    [
        ["--robot", "arm", "--friction-share", "1.0"],
        ["--robot", "arm", "--payload", "heavy"],
        ["--robot", "arm", "--payload", "50"],
        ["--robot", "nobody"],
        ["--robot", "real"],
        ["--robot", "arm", "--seed", "99999999999999"],
    ],
)
def test_nothing_is_made_before_all_is_checked(place, tmp_path, more) -> None:
    given = ["simulate", str(model_folder()), "-o", str(tmp_path / "new")]
    done = CliRunner().invoke(app, [*given, "--station", str(place / "station.yaml"), *more])
    assert isinstance(done.exception, HilError | SystemExit)
    assert done.exit_code
    assert not (tmp_path / "new").exists()


def test_a_seed_beyond_those_there_are_is_refused() -> None:
    with pytest.raises(SpecError, match="the seed is 99999999999999, but must be 0 to"):
        api.simulate(model_folder(), "never-made", seed=99999999999999)


def test_a_folder_that_exists_is_left_alone(tmp_path) -> None:
    with pytest.raises(RecordingError, match="exists already"):
        api.simulate(model_folder(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_another_individual_is_warned_of_before_anything_else(asked) -> None:
    ended, ask = asked
    notes = short_trial()[0].notes
    ended[0] = replace(ended[0], notes=notes)
    assert ask().stdout.startswith(
        f"warning: DIFFERENT INDIVIDUAL: the model was fitted on {ELSEWHERE} and simulated on "
        "arm-full-5"
    )
    assert notes[-1].startswith("guided by less than 20°")


@pytest.mark.thorough
def test_another_individual_that_nobody_asked_for_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HIL_STATION", raising=False)
    with pytest.raises(SpecError, match="no station was set") as refused:
        api.simulate(model_folder(), "new")
    assert "--station FILE" in refused.value.hint
    assert not (tmp_path / "new").exists()
