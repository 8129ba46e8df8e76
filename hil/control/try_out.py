"""What a model is worth to a controller, tried out on a simulated arm that is driven by torque.

A trial (`run_trial`) has two parts. In the first a trajectory of its own is followed by the same PD
controller behind every law of `hil.control.controllers`; only the torque given ahead of any error
differs. In the second a hand, which is a spring and a damper at every joint, firm enough to carry
the arm when the drives give nothing, leads the arm joint by joint and lets go; what it costs is the
torque of that spring while its joint is led. Every run begins on an arm that is opened afresh
(`Bench`). Both motions keep the limits of the arm and its distance from what stands around it, the
load included.

Nothing here commands a torque to a real robot: one that does not declare itself simulated
(`hil.robot.TorqueControlled`) is refused before it is opened.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.control import controllers
from hil.control.controllers import Reference, Spring, spring_for
from hil.control.hand_guiding import HandGuiding, LowPass
from hil.control.model_robot import place_of
from hil.control.try_out_settings import HALF, RATE_HZ, SEEDS_APART, SPEED_HZ
from hil.core import FitError, FloatArray, PlanError, PluginError, RobotFault, SpecError, plugins
from hil.estimators import RobotEstimator, load_model_file, require_torque
from hil.excitation import Workspace
from hil.planning import build_plan, connected, plannable_arm, roadmap_of, workspace_of
from hil.robot import Robot, TorqueControlled, is_simulated
from hil.spec import ExperimentSpec, StationRobot
from hil.studies import listed, mean_of


@dataclass(frozen=True, slots=True)
class TrialPlace:
    """A model, and the simulated arm on which it is tried.

    Attributes:
        folder: Of the model.
        model: The model.
        bench: The arm, and what it carries.
        where: The arm in words.
        named: Whether its station was named.
    """

    folder: Path
    model: RobotEstimator
    bench: Bench
    where: str
    named: bool


def trial_place(
    folder: Path, station: Path | None, robot: str | None, load: Payload | None
) -> TrialPlace:
    """Return the simulated arm of a model; nothing moves.

    Args:
        folder: The model.
        station: Station file; by default the one experiments here would use.
        robot: Name in the station; by default its only robot of the model's kind.
        load: What is mounted, and told to the model.

    Raises:
        FitError: Nobody knows the model's torques.
        SpecError: The robot is no simulated one with torque control, or is another arm.
        DataError: The model cannot be read.
    """
    model = load_model_file(folder)
    require_torque(model)
    entry, found = place_of(model, station, robot)
    name, where = _named(found, entry)
    require_simulated(name, entry)
    bench = Bench(name, entry, load or Payload())
    return TrialPlace(folder, model, bench, where, named=" of " in where)


def _named(where: str, robot: StationRobot) -> tuple[str, str]:
    """The robot's name, which is part of a mock's serial number, and where it is in words."""
    name, told, _ = where.partition(" of ")
    alone = robot.model.replace("@", "_")
    return (name, where) if told else (alone, f"a mock {robot.model} (no station was named)")


Progress = Callable[[str], object]
"""Told what is being run."""

HAND_FIRMNESS = 2.0
"""Times the bandwidth of the trial's controller."""


def run_trial(place: TrialPlace, seed: int, friction_share: float, progress: Progress) -> Trial:
    """Try a model on its simulated arm.

    Args:
        place: Model and arm.
        seed: Of the trajectory; counted apart from those of experiments.
        friction_share: Of the dry friction, compensated while a hand leads; below 1.
        progress: Is told what is being run.

    Raises:
        FitError: The model has no gravity.
        SpecError: Nobody named a station, and the mock there is otherwise is not the arm of the
            model; or an argument cannot be.
        PlanError: There is no clear motion.
    """
    begin = time.perf_counter()
    model, bench = place.model, place.bench
    helped, notes = guidings(model, bench, friction_share)
    progress("planning")
    way = leading_for(bench)
    with bench.arm(way.start) as arm:
        serial = arm.serial
    fitted_on = _same_individual(model, serial, named=place.named)
    reference = trajectory_for(bench, seed)
    pd = spring_for(model.robot_, reference.q[:: round(RATE_HZ / 20)])
    tracked = tracked_by(model, bench, reference, pd, progress)
    led = led_with(helped, model, bench, way, pd.firmer(HAND_FIRMNESS), progress)
    told = (*_about(model, serial, fitted_on), *notes, *_short_ways(way, model.joint_names_))
    return Trial(
        str(place.folder), model.estimator, place.where, serial, fitted_on, model.joint_names_,
        bench.payload, seed, friction_share, pd, tracked, way, led,
        time.perf_counter() - begin, told,
    )  # fmt: skip


def _same_individual(model: RobotEstimator, serial: str, *, named: bool) -> str:
    """Serial number of the arm the model was fitted on.

    Raises:
        SpecError: It is another one than `serial`, which nobody has asked for.
    """
    known = model.training_.serial if model.training_ else ""
    if known and known != serial and not named:
        raise SpecError(
            f"the model was fitted on {known}, but no station was named, and the mock there is "
            f"otherwise is another individual ({serial})",
            hint="--station FILE --robot NAME, with the arm the model was fitted on",
        )
    return known


def _about(model: RobotEstimator, serial: str, fitted_on: str) -> Iterator[str]:
    """What makes all figures mean something else."""
    if fitted_on and fitted_on != serial:
        yield (
            f"ANOTHER INDIVIDUAL: the model was fitted on {fitted_on}, and tried on {serial}, "
            "which has other masses and friction; the figures are not its worth on its own arm"
        )
    if not any("trajectory" in kinds for kinds in model.series_kinds):
        yield (
            f"a static model: {model.estimator} was fitted to arms at rest, and all that it gives "
            "ahead is gravity; it knows neither inertia nor the friction of motion"
        )


SWINGS_DEG = (20.0, -20.0, 10.0, -10.0, 5.0, -5.0)
"""How far a joint is led: the first of these that is clear."""


def _short_ways(way: Leading, names: tuple[str, ...]) -> Iterator[str]:
    """Joints that are led by less than the others, and why."""
    least = np.radians(abs(SWINGS_DEG[0])) * (1 - 1e-6)
    if short := [
        f"{name} {np.degrees(abs(swing)):.3g}°"
        for name, swing in zip(names, way.swing, strict=True)
        if abs(swing) < least
    ]:
        yield (
            f"led by less than {abs(SWINGS_DEG[0]):g}°, so as to keep clear alone and all "
            f"together: {', '.join(short)}"
        )


@dataclass(frozen=True, slots=True)
class Bench:
    """Which simulated arm, and what it carries.

    Attributes:
        name: Of the robot in its station.
        robot: Its entry there.
        payload: What is mounted, and declared.
    """

    name: str
    robot: StationRobot
    payload: Payload

    @contextlib.contextmanager
    def arm(self, q_start: FloatArray) -> Iterator[Arm]:
        """The arm at rest in a pose (n,) [rad], its brakes released by the first torque.

        Raises:
            SpecError: The robot is not a simulated one that can be driven by torque.
            RobotError: It does not come up.
        """
        options: dict[str, Any] = {
            **self.robot.options,
            "start_q_deg": np.degrees(q_start).tolist(),
            "rate_hz": RATE_HZ,
            "block": 1,
        }
        # A process of its own would put a pipe between every two samples.
        ours = self.robot.model_copy(update={"options": options, "own_process": False})
        with connected(self.name, ours) as robot:
            if not self.payload.is_empty:
                robot.set_payload(self.payload)
            yield Arm(robot)


REFUSED = "torque is commanded to simulated arms alone"


def require_simulated(name: str, robot: StationRobot) -> None:
    """Refuse a robot that is not a simulated one on a virtual clock, before it is opened.

    Raises:
        SpecError: It is not.
        PluginError: Its driver is missing.
    """
    try:
        driver = plugins.load("hil.drivers", robot.driver)
    except PluginError as error:
        raise PluginError(f"{name}: {error.message}", hint=error.hint) from error
    if not is_simulated(driver):
        raise SpecError(
            f"{name} has the driver {robot.driver}, which does not declare itself a simulated arm "
            f"under torque control: {REFUSED}",
            hint="choose a station whose robot has driver: mock (experiments/stations/mock.yaml)",
        )
    if robot.options.get("clock", "virtual") != "virtual":
        raise SpecError(
            f"{name} runs on wall time, but a trial steps its arm sample by sample",
            hint="take clock: wall (and speed, queue_s, watchdog_s) out of the robot's options",
        )


class Arm:
    """One robot, a sample at a time.

    Attributes:
        q, qd: (n,) as measured last [rad, rad/s].
        limit: (n,) torque limits [N·m].
        gains: (n,) torque per current that its controller assumes [N·m/A].
    """

    def __init__(self, robot: Robot) -> None:
        if not (is_simulated(robot) and isinstance(robot, TorqueControlled)):
            raise SpecError(
                f"{robot.identity.model} is no simulated arm under torque control: {REFUSED}"
            )
        self._robot = robot
        limits, can = robot.limits, robot.capabilities
        self.serial = robot.identity.serial
        self.limit, self.speed_limit = limits.effort_max, limits.qd_max
        self.gains = np.array(can.drive_gains)
        self._still = np.zeros(len(can.joint_names))
        self.q = self.qd = self._still
        self._read()

    def step(self, torque: FloatArray, push: FloatArray | None = None) -> bool:
        """Drive by a torque (n,) [N·m] within the limits, pushed by another, for one sample.

        Returns:
            Whether the arm can go on: False when it is too fast or has a fault, or when the
            torque is no number. It is braked then.
        """
        if not np.isfinite(torque).all():
            self.brake()
            return False
        try:
            self._robot.command_torque(np.clip(torque, -self.limit, self.limit))
            self._robot.push(self._still if push is None else push)
            self._read()
        except RobotFault:
            return False
        if np.all(np.abs(self.qd) <= self.speed_limit):
            return True
        self.brake()
        return False

    def brake(self) -> None:
        """Let the brakes bring the arm to rest, nobody pushing."""
        with contextlib.suppress(RobotFault):
            self._robot.push(self._still)
            self._robot.command_torque(None)

    def wait(self) -> bool:
        """Let one sample pass with things as they are; False when the arm has a fault."""
        try:
            self._read()
        except RobotFault:
            return False
        return True

    def _read(self) -> None:
        row = self._robot.read()[-1]
        self.q, self.qd = np.array(row["q"]), np.array(row["qd"])


SETTLE_S = 1.0
"""At rest before the motion begins; not counted."""


def spec_of(name: str, payload: Payload, seed: int) -> ExperimentSpec:
    """A Fourier trajectory of ten seconds with a load mounted."""
    load = {"mass_kg": payload.mass, "com_m": payload.com, "inertia_kgm2": payload.inertia}
    return ExperimentSpec.model_validate(
        {
            "hil": 1,
            "name": "try-out",
            "robot": name,
            "excitation": {
                "kind": "fourier",
                "trajectories": 1,
                "seed": SEEDS_APART + seed,
                "max_velocity_deg_s": 80,
                "max_acceleration_deg_s2": 200,
            },
            "loads": [{"mass_kg": 0.0} if payload.is_empty else load],
            "reference": {"every": 0},
        }
    )


def trajectory_for(bench: Bench, seed: int) -> Reference:
    """A trajectory from rest to rest, of a seed that experiments do not have by themselves.

    Raises:
        PlanError: There is no clear one.
        SpecError: The load is more than the arm can carry.
    """
    spec = spec_of(bench.name, bench.payload, seed)
    plan = build_plan(spec, bench.robot, rate_hz=RATE_HZ)
    motion = next(step.motion for step in plan.steps if step.kind == "trajectory")
    assert motion is not None
    samples = motion.sample(RATE_HZ)
    rest = round(SETTLE_S * RATE_HZ)
    still = np.zeros((rest, len(motion.q_start)))
    return Reference(
        np.arange(1 - rest, len(samples) + 1) / RATE_HZ,
        np.concatenate((still + motion.q_start, samples.q)),
        np.concatenate((still, samples.qd)),
        np.concatenate((still, samples.qdd)),
    )


LEAD_S = 4.0
"""A hand takes this long to lead a joint forth and back."""


@dataclass(frozen=True, slots=True, eq=False)
class Leading:
    """A way for a hand: every joint in turn, then all together.

    Attributes:
        start: (n,) pose [rad].
        swing: (n,) how far each joint is led [rad].
        turn_s: How long a joint is led forth and back [s].
    """

    start: FloatArray
    swing: FloatArray
    turn_s: float = LEAD_S

    @property
    def turns_s(self) -> float:
        """When every joint has had its turn [s]."""
        return self.turn_s * len(self.start)

    @property
    def release_s(self) -> float:
        """When the hand lets go: on the way of all joints together, at its fastest [s]."""
        return self.turns_s + self.turn_s / 4

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Position and velocity (n,) of the hand [rad, rad/s]; at rest before 0."""
        share, rate = np.zeros_like(self.swing), np.zeros_like(self.swing)
        if t >= 0.0:
            now = slice(None) if t >= self.turns_s else int(t // self.turn_s)
            omega = np.pi / self.turn_s
            phase = omega * (t % self.turn_s)
            share[now], rate[now] = np.sin(phase) ** 2, omega * np.sin(2 * phase)
        return self.start + self.swing * share, self.swing * rate


def leading_for(bench: Bench) -> Leading:
    """A way for a hand about the roomiest pose of the arm.

    Raises:
        PlanError: A joint cannot be led by even 5°.
    """
    arm = plannable_arm(bench.robot)
    workspace = workspace_of(spec_of(bench.name, bench.payload, 0), bench.robot, arm, RATE_HZ)
    start = roadmap_of(workspace).home
    swing = [_swing(workspace, start, j) for j in range(len(start))]
    together = Leading(start, np.array(swing))
    # All together may touch what no joint alone does.
    while not workspace.is_clear(_along(together.start, together.swing)).all():
        together = Leading(start, together.swing / 2)
        if np.abs(together.swing).max() < np.radians(1.0):
            raise PlanError(
                "no clear path leads all joints of the arm together",
                hint="make the range smaller, or give the obstacles of the station more room",
            )
    return together


def _swing(workspace: Workspace, start: FloatArray, joint: int) -> float:
    for degrees in SWINGS_DEG:
        way = np.zeros_like(start)
        way[joint] = np.radians(degrees)
        if workspace.is_clear(_along(start, way)).all():
            return float(way[joint])
    raise PlanError(
        f"{workspace.joint_names[joint]} cannot be led by {abs(SWINGS_DEG[-1]):g}° about the "
        "roomiest pose of the arm",
        hint="describe the station's surroundings as they are",
    )


def _along(start: FloatArray, way: FloatArray) -> FloatArray:
    return start + np.linspace(0.0, 1.0, 21)[:, None] * way


def tracked_by(
    model: RobotEstimator, bench: Bench, reference: Reference, pd: Spring, progress: Progress
) -> tuple[Tracked, ...]:
    """A run for each law, all with the same controller."""
    with bench.arm(reference.q[0]) as arm:
        gains = arm.gains
    runs = []
    for law, ahead in controllers.feed_forwards(model, bench.payload, reference, gains):
        progress(f"tracking: {law}")
        with bench.arm(reference.q[0]) as arm:
            runs.append(track(arm, law, ahead, reference, pd))
    return tuple(runs)


MOST_ERROR_RAD = 0.35
"""Further from the trajectory the arm is braked."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One run.

    Attributes:
        law: What was given ahead.
        t: (N,) time [s]; up to where the arm was braked, if it was.
        error: (N, n) position wanted minus position [rad].
        stopped: Why the arm was braked; empty when it went to the end.
    """

    law: str
    t: FloatArray
    error: FloatArray
    stopped: str = ""

    @property
    def rms(self) -> FloatArray:
        """(n,) of the error [rad]; NaN where the arm was braked."""
        return self._judged(np.sqrt(np.mean(self.error**2, axis=0)))

    @property
    def worst(self) -> FloatArray:
        """(n,) largest error [rad]; NaN where the arm was braked."""
        return self._judged(np.abs(self.error).max(axis=0))

    def _judged(self, values: FloatArray) -> FloatArray:
        return np.full_like(values, np.nan) if self.stopped else values


def track(arm: Arm, law: str, ahead: FloatArray, reference: Reference, pd: Spring) -> Tracked:
    """Follow a reference; the rest before it does not count.

    Args:
        arm: At rest at the beginning of the reference.
        law: Name of the law.
        ahead: (N, n) its torque [N·m].
        reference: N samples.
        pd: The controller.
    """
    errors, stopped = [], ""
    for q, qd, torque in zip(reference.q, reference.qd, ahead, strict=True):
        if not arm.step(torque + pd.torque(q - arm.q, qd - arm.qd)):
            stopped = "too fast, or a fault"
            break
        errors.append(q - arm.q)
        if np.abs(errors[-1]).max() > MOST_ERROR_RAD:
            joint = int(np.abs(errors[-1]).argmax())
            stopped = f"J{joint + 1} was {np.degrees(MOST_ERROR_RAD):.0f}° off"
            arm.brake()
            break
    counted = reference.t[: len(errors)] > 0
    t, error = reference.t[: len(errors)], np.array(errors).reshape(-1, reference.q.shape[1])
    if stopped:
        return Tracked(law, t, error, f"{stopped} at {reference.t[len(errors) - 1]:.2f} s")
    return Tracked(law, t[counted], error[counted])


NOTHING, DATASHEET = "drives off", "datasheet gravity"

Drives = Callable[[FloatArray, FloatArray], FloatArray]
"""Torque (n,) [N·m] from position and velocity."""

GRAVITY, FRICTION = "gravity", "gravity and friction"

OF_THE_MODEL = (GRAVITY, FRICTION)


def guidings(
    model: RobotEstimator, bench: Bench, friction_share: float
) -> tuple[dict[str, HandGuiding], list[str]]:
    """What the model helps a hand with, and what was left out.

    Raises:
        FitError: The model has no gravity.
        SpecError: There can be no such share.
    """
    helped = {GRAVITY: HandGuiding(model, bench.payload, friction_share=0.0)}
    try:
        helped[FRICTION] = HandGuiding(model, bench.payload, friction_share=friction_share)
    except FitError as error:
        return helped, [f"{error.message}: a hand is helped by gravity alone"]
    return helped, []


def led_with(
    helped: Mapping[str, HandGuiding],
    model: RobotEstimator,
    bench: Bench,
    way: Leading,
    hand: Spring,
    progress: Progress,
) -> tuple[Led, ...]:
    """A run for each way of helping a hand, the same hand every time."""
    runs = []
    for name in (NOTHING, DATASHEET, *helped):
        progress(f"led by hand: {name}")
        with bench.arm(way.start) as arm:
            drives: Drives | None = None
            if name == DATASHEET:
                drives = _datasheet(model, bench)
            elif name in helped:
                drives = in_torque(helped[name], arm)
            runs.append(lead(arm, name, drives, way, hand))
    return tuple(runs)


def _datasheet(model: RobotEstimator, bench: Bench) -> Drives:
    """Gravity of the arm as its maker describes it, with the load [N·m]."""
    loaded = controllers.as_made(model.robot_, bench.payload)

    def gravity(q: FloatArray, qd: FloatArray) -> FloatArray:
        held: FloatArray = loaded.gravity(q[None])[0]
        return held

    return gravity


def in_torque(guiding: HandGuiding, arm: Arm) -> Drives:
    """What it gives, in N·m as the arm's own controller counts."""
    scale = arm.gains if guiding.unit == "A" else np.ones_like(arm.gains)
    # Unfiltered, wrists do not come to rest: see hil.control.hand_guiding.
    slow = LowPass(SPEED_HZ, RATE_HZ)
    return lambda q, qd: guiding(q, slow(qd)) * scale


MOST_STRAY_RAD = 0.6
"""Further from the hand the arm is braked."""

ALONE_S = 3.0
"""It is watched after the hand has let go."""

AT_REST_RAD_S = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Led:
    """One run.

    Attributes:
        way: What the drives gave.
        turn_s: How long each joint was led, one after the other [s].
        t: (N,) time while it was led [s].
        effort: (N, n) torque of the hand [N·m].
        q: (N, n) where the arm was [rad].
        ran_on: (n,) how far joints went on after the hand had let go [rad].
        rest_s: When all joints were at rest, after that [s]; infinite when never.
        stopped: Why the arm was braked; empty when it was not.
    """

    way: str
    turn_s: float
    t: FloatArray
    effort: FloatArray
    q: FloatArray
    ran_on: FloatArray
    rest_s: float
    stopped: str = ""

    @property
    def rms(self) -> FloatArray:
        """(n,) effort of the hand at each joint while that is led [N·m]."""
        return self._own_turn(lambda rows: float(np.sqrt(np.mean(rows**2))))

    @property
    def peak(self) -> FloatArray:
        """(n,) largest effort of the hand at each joint while that is led [N·m]."""
        return self._own_turn(lambda rows: float(np.abs(rows).max()))

    @property
    def turn(self) -> FloatArray:
        """(N,) which joint was led, n and more for all."""
        return np.floor(self.t / self.turn_s)

    def _own_turn(self, figure: Callable[[FloatArray], float]) -> FloatArray:
        n = self.effort.shape[1]
        if self.stopped:
            return np.full(n, np.nan)
        return np.array([figure(self.effort[self.turn == j, j]) for j in range(n)])


def lead(arm: Arm, way: str, drives: Drives | None, leading: Leading, hand: Spring) -> Led:
    """Lead an arm along a way, and let it go while it moves.

    Args:
        arm: At rest at the beginning of the way.
        way: Name of what the drives give.
        drives: That; None for nothing, and brakes when the hand lets go.
        leading: The way.
        hand: How firm the hand is.
    """
    still = np.zeros_like(leading.start)
    give = drives or (lambda q, qd: still)
    efforts, places, stopped = [], [], ""
    t = np.arange(1 - round(SETTLE_S * RATE_HZ), round(leading.release_s * RATE_HZ)) / RATE_HZ
    for now in t:
        q, qd = leading.at(float(now))
        effort = hand.torque(q - arm.q, qd - arm.qd)
        going = arm.step(give(arm.q, arm.qd), effort)
        efforts.append(effort)
        places.append(arm.q)
        if not going or np.abs(q - arm.q).max() > MOST_STRAY_RAD:
            arm.brake()
            stopped = f"the arm strayed from the hand at {now:.2f} s"
            break
    led = t[: len(efforts)] >= 0
    pieces = (t[: len(efforts)][led], np.array(efforts)[led], np.array(places)[led])
    if stopped:
        return Led(way, leading.turn_s, *pieces, np.full_like(still, np.nan), float("inf"), stopped)
    return Led(way, leading.turn_s, *pieces, *_let_go(arm, drives))


def _let_go(arm: Arm, drives: Drives | None) -> tuple[FloatArray, float, str]:
    """(n,) how far the joints ran on, when they were at rest, and why the arm was braked."""
    released, rest_s, stopped = arm.q.copy(), float("inf"), ""
    if drives is None:
        arm.brake()
    for k in range(round(ALONE_S * RATE_HZ)):
        if drives is None or stopped:
            arm.wait()
        elif not arm.step(drives(arm.q, arm.qd)):
            stopped = "it ran away when the hand had let go"
        moving = np.abs(arm.qd).max() > AT_REST_RAD_S
        rest_s = float("inf") if moving else min(rest_s, k / RATE_HZ)
    return np.abs(arm.q - released), rest_s, stopped


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What a model was worth to a controller.

    Attributes:
        model: Its folder.
        estimator: What fitted it.
        robot: Name in the station, and the station in words.
        serial: Of the arm it was tried on.
        fitted_on: Serial number of the arm it was fitted on; empty when nobody said.
        joint_names: Length n.
        payload: What was mounted.
        seed: Of the trajectory.
        friction_share: Of the dry friction, compensated while a hand leads.
        pd: The controller that all laws share.
        tracked: A run for each law.
        leading: The way of the hand.
        led: A run for each way of helping the hand.
        seconds: It all took.
        notes: What else one should know, the gravest first.
    """

    model: str
    estimator: str
    robot: str
    serial: str
    fitted_on: str
    joint_names: tuple[str, ...]
    payload: Payload
    seed: int
    friction_share: float
    pd: Spring
    tracked: tuple[Tracked, ...]
    leading: Leading
    led: tuple[Led, ...]
    seconds: float
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the model met all that it is held to (`hil.control.try_out`)."""
        return all(criterion.met for criterion in judged(self))

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil try-out --json`."""
        return {
            "ok": self.ok,
            "criteria": [asdict(criterion) for criterion in judged(self)],
            "model": self.model,
            "estimator": self.estimator,
            "robot": self.robot,
            "serial": self.serial,
            "fitted_on": self.fitted_on,
            "joint_names": list(self.joint_names),
            "payload": {"mass_kg": self.payload.mass, "com_m": list(self.payload.com)},
            "seed": self.seed,
            "rate_hz": RATE_HZ,
            "pd": {
                "stiffness_nm_rad": self.pd.stiffness.tolist(),
                "damping_nms_rad": self.pd.damping.tolist(),
            },
            "tracking": [_tracked(run) for run in self.tracked],
            "hand": {
                "firmness": HAND_FIRMNESS,
                "friction_share": self.friction_share,
                "speed_low_pass_hz": SPEED_HZ,
                "swing_rad": self.leading.swing.tolist(),
                "led": [_led(run) for run in self.led],
            },
            "seconds": self.seconds,
            "notes": list(self.notes),
        }


def _tracked(run: Tracked) -> dict[str, Any]:
    return {
        "law": run.law,
        "rms_rad": _numbers(run.rms),
        "worst_rad": _numbers(run.worst),
        "stopped": run.stopped,
    }


def _numbers(values: FloatArray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _led(run: Led) -> dict[str, Any]:
    return {
        "way": run.way,
        "rms_nm": _numbers(run.rms),
        "peak_nm": _numbers(run.peak),
        "ran_on_rad": _numbers(run.ran_on),
        "rest_after_s": run.rest_s if np.isfinite(run.rest_s) else None,
        "stopped": run.stopped,
    }


@dataclass(frozen=True, slots=True)
class Criterion:
    """One of them.

    Attributes:
        name: Short and stable.
        asked: What is asked for.
        met: Whether it is so.
        found: What was found instead, in words.
        mend: What to do when it is not met.
    """

    name: str
    asked: str
    met: bool
    found: str
    mend: str


ENDED, RESTED, TRACKED, HELPED = "ended", "at rest", "tracking", "hand"


def judged(trial: Trial) -> tuple[Criterion, ...]:
    """All of them. Runs without the model are what it is compared with, and not judged."""
    return (*_runs(trial), _tracking(trial), _hand(trial))


def _runs(trial: Trial) -> Iterator[Criterion]:
    ways = [run for run in trial.led if run.way in OF_THE_MODEL]
    braked = [f"{run.law}: {run.stopped}" for run in trial.tracked
              if run.stopped and run.law not in controllers.UNIDENTIFIED]  # fmt: skip
    braked += [f"{run.way}: {run.stopped}" for run in ways if run.stopped]
    yield Criterion(
        ENDED, "no run with the model has to be braked", not braked,
        f"BRAKED, {listed(braked)}" if braked else "none was",
        "try a model that was fitted on this very arm, or --friction-share 0",
    )  # fmt: skip
    restless = [run.way for run in ways if not np.isfinite(run.rest_s)]
    last = max((run.rest_s for run in ways), default=np.nan)
    yield Criterion(
        RESTED, "let go, the arm comes to rest", not restless,
        f"NOT AT REST with {listed(restless)}" if restless else f"within {last:.1f} s every time",
        "take less of the friction (--friction-share), or a model that knows gravity better",
    )  # fmt: skip


def _tracking(trial: Trial) -> Criterion:
    better = improvement(trial)
    best = unaided(trial)
    found = (
        f"an error {better:.1f} times smaller than with {best}"
        if np.isfinite(better)
        else "not known"
    )
    return Criterion(
        TRACKED, "the model tracks better than what needs no identification", bool(better > 1.0),
        found, "fit a model with inertia and friction, to trajectories of this very arm",
    )  # fmt: skip


def _hand(trial: Trial) -> Criterion:
    way = most_help(trial)
    share = relief(trial, way, NOTHING)
    found = f"with {way} {halves(share)}" if np.isfinite(share).all() else "not known"
    return Criterion(
        HELPED, "effort of the hand at most half of that with the drives off, in every joint",
        bool(np.all(share <= HALF)), found,
        "take more of the friction (--friction-share, below 1), or a model that knows it better",
    )  # fmt: skip


def unaided(trial: Trial) -> str:
    """The law that tracks best of those that need no identification; empty when all were braked."""
    known = {
        run.law: mean_of(run.rms) for run in trial.tracked if run.law in controllers.UNIDENTIFIED
    }
    known = {law: rms for law, rms in known.items() if np.isfinite(rms)}
    return min(known, key=lambda law: known[law], default="")


def improvement(trial: Trial) -> float:
    """Mean RMS error with the best law that needs no identification over that with the model."""
    by_law = {run.law: mean_of(run.rms) for run in trial.tracked}
    return by_law.get(unaided(trial), np.nan) / by_law[controllers.MODEL]


def relief(trial: Trial, of: str, over: str) -> FloatArray:
    """(n,) RMS effort of the hand with one help over that with another; NaN without a run."""
    by_way = {run.way: run.rms for run in trial.led}
    if of not in by_way or over not in by_way:
        return np.full(len(trial.joint_names), np.nan)
    return by_way[of] / by_way[over]


def most_help(trial: Trial) -> str:
    """The most that the model helps a hand with."""
    return [run.way for run in trial.led if run.way in OF_THE_MODEL][-1]


def halves(share: FloatArray) -> str:
    """Which joints of (n,) are at most half, and the mean, in words."""
    half = [f"J{j + 1}" for j in np.flatnonzero(share <= HALF)]
    which = "every joint" if len(half) == len(share) else listed(half) or "no joint"
    each = " ".join(f"{100 * value:.0f}" for value in share)
    return f"{each} % (mean {100 * np.mean(share):.0f} %): at most half in {which}"
