"""Control trial: benefit of a model for control, measured on a simulated torque-driven arm.

A control trial (`run_trial`) has two parts: tracking and hand guiding. In the first part of a
trial, the same PD controller tracks a separate trajectory with every feed-forward law of
`hil.control.controllers`; only the feed-forward torque differs. In the second part of a trial, a
simulated hand guides the arm joint by joint and then releases the arm. The simulated hand is a
spring and a damper at every joint, stiff enough to carry the arm without drives. The effort of the
hand at a joint is the torque of its spring while this joint is guided. Every run of a trial starts
on a newly opened arm (`Bench`). The tracking motion and the guided motion satisfy the limits of the
arm and the clearance to the surroundings, including the payload.

The trial never commands torque to a real robot: a robot that does not declare itself simulated
(`hil.robot.TorqueControlled`) is rejected before it is opened.
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
    """Model, and the simulated arm on which it is tested.

    Attributes:
        folder: Path of the model folder.
        model: Fitted model.
        bench: Simulated arm with its payload.
        where: Description of the simulated arm.
        named: Whether the user specified the station.
    """

    folder: Path
    model: RobotEstimator
    bench: Bench
    where: str
    named: bool


def trial_place(
    folder: Path, station: Path | None, robot: str | None, load: Payload | None
) -> TrialPlace:
    """Return the simulated arm for a model without moving it.

    Args:
        folder: Path of the model folder.
        station: Path of the station file; by default the default station of experiments in the
            working directory.
        robot: Name of the robot in the station; by default the only robot in the station that is
            the arm of the model.
        load: Payload that is mounted, also passed to the model.

    Raises:
        FitError: The model cannot predict torques.
        SpecError: The robot is not a simulated robot with torque control, or it is a different arm
            than the model.
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
    """Return the robot name, which is part of the serial number of a mock, and its description."""
    name, told, _ = where.partition(" of ")
    alone = robot.model.replace("@", "_")
    return (name, where) if told else (alone, f"a mock {robot.model} (no station was named)")


Progress = Callable[[str], object]
"""Callback that receives the name of the current step."""

HAND_FIRMNESS = 2.0
"""Ratio of the bandwidth of the hand to the bandwidth of the PD controller."""


def run_trial(place: TrialPlace, seed: int, friction_share: float, progress: Progress) -> Trial:
    """Run a control trial of a model on its simulated arm.

    Args:
        place: Model and simulated arm.
        seed: Seed of the trajectory, in a range that experiments do not use.
        friction_share: Compensated share of the dry friction during hand guiding; below 1.
        progress: Callback that receives the name of the current step.

    Raises:
        FitError: The model has no gravity part.
        SpecError: No station was specified and the default mock robot is not the arm of the model;
            or an argument is invalid.
        PlanError: No collision-free motion was found.
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
    """Return the serial number of the arm on which the model was fitted.

    Raises:
        SpecError: The serial number differs from `serial`, and no station was specified.
    """
    known = model.training_.serial if model.training_ else ""
    if known and known != serial and not named:
        raise SpecError(
            f"the model was fitted on {known}, but no station was set, and the default mock is a "
            f"different individual ({serial})",
            hint="select the arm of the model with --station FILE --robot NAME",
        )
    return known


def _about(model: RobotEstimator, serial: str, fitted_on: str) -> Iterator[str]:
    """Yield notes about circumstances that change the meaning of all results."""
    if fitted_on and fitted_on != serial:
        yield (
            f"DIFFERENT INDIVIDUAL: the model was fitted on {fitted_on} and simulated on {serial}, "
            "whose masses and friction differ; the results are not valid for the arm of the model"
        )
    if not any("trajectory" in kinds for kinds in model.series_kinds):
        yield (
            f"static model: {model.estimator} was fitted to static samples, so its feed-forward "
            "torque is gravity only, without inertia and friction of motion"
        )


SWINGS_DEG = (20.0, -20.0, 10.0, -10.0, 5.0, -5.0)
"""Candidate amplitudes of a joint during hand guiding [°]; the first collision-free amplitude is
used."""


def _short_ways(way: Leading, names: tuple[str, ...]) -> Iterator[str]:
    """Yield a note about joints that are guided over a smaller angle than the others."""
    least = np.radians(abs(SWINGS_DEG[0])) * (1 - 1e-6)
    if short := [
        f"{name} {np.degrees(abs(swing)):.3g}°"
        for name, swing in zip(names, way.swing, strict=True)
        if abs(swing) < least
    ]:
        yield (
            f"guided by less than {abs(SWINGS_DEG[0]):g}° to avoid collisions: {', '.join(short)}"
        )


@dataclass(frozen=True, slots=True)
class Bench:
    """Simulated arm of a trial with its payload.

    Attributes:
        name: Name of the robot in its station.
        robot: Entry of the robot in the station file.
        payload: Payload that is mounted and declared.
    """

    name: str
    robot: StationRobot
    payload: Payload

    @contextlib.contextmanager
    def arm(self, q_start: FloatArray) -> Iterator[Arm]:
        """Yield the arm, static in a pose (n,) [rad]; the first torque command releases the brakes.

        Raises:
            SpecError: The robot is not a simulated robot with torque control.
            RobotError: The robot cannot be opened.
        """
        options: dict[str, Any] = {
            **self.robot.options,
            "start_q_deg": np.degrees(q_start).tolist(),
            "rate_hz": RATE_HZ,
            "block": 1,
        }
        # A separate process would add inter-process communication at every sample.
        ours = self.robot.model_copy(update={"options": options, "own_process": False})
        with connected(self.name, ours) as robot:
            if not self.payload.is_empty:
                robot.set_payload(self.payload)
            yield Arm(robot)


REFUSED = "torque is commanded to simulated arms only"


def require_simulated(name: str, robot: StationRobot) -> None:
    """Raise if a robot is not simulated on a virtual clock; the robot is not opened.

    Raises:
        SpecError: The robot is not simulated on a virtual clock.
        PluginError: The driver of the robot is not installed.
    """
    try:
        driver = plugins.load("hil.drivers", robot.driver)
    except PluginError as error:
        raise PluginError(f"{name}: {error.message}", hint=error.hint) from error
    if not is_simulated(driver):
        raise SpecError(
            f"{name} has the driver {robot.driver}, which does not declare a simulated arm "
            f"under torque control: {REFUSED}",
            hint="choose a station whose robot has driver: mock (experiments/stations/mock.yaml)",
        )
    if robot.options.get("clock", "virtual") != "virtual":
        raise SpecError(
            f"{name} runs on wall time, but a simulation needs an arm on a virtual clock",
            hint="remove clock: wall (and speed, queue_s, watchdog_s) from the robot's options",
        )


class Arm:
    """Access to one simulated robot, sample by sample.

    Attributes:
        q, qd: (n,) measured positions and velocities of the newest sample [rad, rad/s].
        limit: (n,) torque limits [N·m].
        gains: (n,) drive gains that the controller of the robot assumes, torque per current
            [N·m/A].
    """

    def __init__(self, robot: Robot) -> None:
        if not (is_simulated(robot) and isinstance(robot, TorqueControlled)):
            raise SpecError(
                f"{robot.identity.model} is not a simulated arm with torque control: {REFUSED}"
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
        """Apply a limited torque (n,) [N·m] and the external torque `push` for one sample.

        Returns:
            Whether the arm can continue to move. The method returns False if the arm is too fast or
            has a fault, or if the torque is not finite; the brakes are then applied.
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
        """Apply the brakes of the arm and remove the external torque."""
        with contextlib.suppress(RobotFault):
            self._robot.push(self._still)
            self._robot.command_torque(None)

    def wait(self) -> bool:
        """Advance by one sample without new commands; return False after a fault of the arm."""
        try:
            self._read()
        except RobotFault:
            return False
        return True

    def _read(self) -> None:
        row = self._robot.read()[-1]
        self.q, self.qd = np.array(row["q"]), np.array(row["qd"])


SETTLE_S = 1.0
"""Duration of the static phase before the motion [s]; this phase is excluded from the results."""


def spec_of(name: str, payload: Payload, seed: int) -> ExperimentSpec:
    """Return the spec of a Fourier trajectory of 10 s with a mounted payload."""
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
    """Return a trajectory from rest to rest, with a seed outside the range of experiments.

    Raises:
        PlanError: No collision-free trajectory was found.
        SpecError: The payload exceeds the rated payload of the arm.
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
"""Time in which the hand guides one joint forth and back [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Leading:
    """Path of the simulated hand: every joint in turn, then all joints together.

    Attributes:
        start: (n,) joint positions of the start pose [rad].
        swing: (n,) amplitude of the motion of each joint [rad].
        turn_s: Time in which the hand guides one joint forth and back [s].
    """

    start: FloatArray
    swing: FloatArray
    turn_s: float = LEAD_S

    @property
    def turns_s(self) -> float:
        """Time after which all joints have been guided one by one [s]."""
        return self.turn_s * len(self.start)

    @property
    def release_s(self) -> float:
        """Time at which the hand releases the arm, at the peak speed of the common motion [s]."""
        return self.turns_s + self.turn_s / 4

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity (n,) of the hand [rad, rad/s]; static before time 0."""
        share, rate = np.zeros_like(self.swing), np.zeros_like(self.swing)
        if t >= 0.0:
            now = slice(None) if t >= self.turns_s else int(t // self.turn_s)
            omega = np.pi / self.turn_s
            phase = omega * (t % self.turn_s)
            share[now], rate[now] = np.sin(phase) ** 2, omega * np.sin(2 * phase)
        return self.start + self.swing * share, self.swing * rate


def leading_for(bench: Bench) -> Leading:
    """Return a path of the hand around the pose with the largest clearance.

    Raises:
        PlanError: A joint cannot be guided without collision, even by only 5°.
    """
    arm = plannable_arm(bench.robot)
    workspace = workspace_of(spec_of(bench.name, bench.payload, 0), bench.robot, arm, RATE_HZ)
    start = roadmap_of(workspace).home
    swing = [_swing(workspace, start, j) for j in range(len(start))]
    together = Leading(start, np.array(swing))
    # The common motion possibly collides although no single joint motion does.
    while not workspace.is_clear(_along(together.start, together.swing)).all():
        together = Leading(start, together.swing / 2)
        if np.abs(together.swing).max() < np.radians(1.0):
            raise PlanError(
                "there is no collision-free path with all joints together",
                hint="reduce the range, or move the obstacles of the station",
            )
    return together


def _swing(workspace: Workspace, start: FloatArray, joint: int) -> float:
    for degrees in SWINGS_DEG:
        way = np.zeros_like(start)
        way[joint] = np.radians(degrees)
        if workspace.is_clear(_along(start, way)).all():
            return float(way[joint])
    raise PlanError(
        f"{workspace.joint_names[joint]} cannot be guided by {abs(SWINGS_DEG[-1]):g}° about the "
        "roomiest pose of the arm",
        hint="check the surroundings in the station file",
    )


def _along(start: FloatArray, way: FloatArray) -> FloatArray:
    return start + np.linspace(0.0, 1.0, 21)[:, None] * way


def tracked_by(
    model: RobotEstimator, bench: Bench, reference: Reference, pd: Spring, progress: Progress
) -> tuple[Tracked, ...]:
    """Return the tracking runs for all feed-forward laws, all with the same controller."""
    with bench.arm(reference.q[0]) as arm:
        gains = arm.gains
    runs = []
    for law, ahead in controllers.feed_forwards(model, bench.payload, reference, gains):
        progress(f"tracking: {law}")
        with bench.arm(reference.q[0]) as arm:
            runs.append(track(arm, law, ahead, reference, pd))
    return tuple(runs)


MOST_ERROR_RAD = 0.35
"""Tracking error of a joint above which the brakes of the arm are applied [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Result of one tracking run of a control trial.

    Attributes:
        law: Name of the feed-forward law.
        t: (N,) time [s]; ends early if the brakes were applied.
        error: (N, n) tracking error, set-point minus position [rad].
        stopped: Reason why the brakes were applied; empty if the run was completed.
    """

    law: str
    t: FloatArray
    error: FloatArray
    stopped: str = ""

    @property
    def rms(self) -> FloatArray:
        """RMS (n,) of the tracking error [rad]; NaN if the brakes were applied."""
        return self._judged(np.sqrt(np.mean(self.error**2, axis=0)))

    @property
    def worst(self) -> FloatArray:
        """Maximum (n,) of the tracking error [rad]; NaN if the brakes were applied."""
        return self._judged(np.abs(self.error).max(axis=0))

    def _judged(self, values: FloatArray) -> FloatArray:
        return np.full_like(values, np.nan) if self.stopped else values


def track(arm: Arm, law: str, ahead: FloatArray, reference: Reference, pd: Spring) -> Tracked:
    """Track a reference motion and return the result without the initial static phase.

    Args:
        arm: Simulated arm, static at the beginning of the reference.
        law: Name of the feed-forward law.
        ahead: (N, n) feed-forward torque [N·m].
        reference: Reference motion of N samples.
        pd: PD controller.
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
"""Torque law of the drives: torque (n,) [N·m] from position and velocity."""

GRAVITY, FRICTION = "gravity", "gravity and friction"

OF_THE_MODEL = (GRAVITY, FRICTION)


def guidings(
    model: RobotEstimator, bench: Bench, friction_share: float
) -> tuple[dict[str, HandGuiding], list[str]]:
    """Return the hand-guiding laws of the model, and notes about laws that are impossible.

    Raises:
        FitError: The model has no gravity part.
        SpecError: The friction share is outside its allowed range.
    """
    helped = {GRAVITY: HandGuiding(model, bench.payload, friction_share=0.0)}
    try:
        helped[FRICTION] = HandGuiding(model, bench.payload, friction_share=friction_share)
    except FitError as error:
        return helped, [f"{error.message}: hand guiding uses gravity only"]
    return helped, []


def led_with(
    helped: Mapping[str, HandGuiding],
    model: RobotEstimator,
    bench: Bench,
    way: Leading,
    hand: Spring,
    progress: Progress,
) -> tuple[Led, ...]:
    """Return the hand-guiding runs for all torque laws of the drives, with the same hand."""
    runs = []
    for name in (NOTHING, DATASHEET, *helped):
        progress(f"hand guiding: {name}")
        with bench.arm(way.start) as arm:
            drives: Drives | None = None
            if name == DATASHEET:
                drives = _datasheet(model, bench)
            elif name in helped:
                drives = in_torque(helped[name], arm)
            runs.append(lead(arm, name, drives, way, hand))
    return tuple(runs)


def _datasheet(model: RobotEstimator, bench: Bench) -> Drives:
    """Return the torque law [N·m] for gravity of the nominal arm and its payload.

    The nominal arm has the parameters of the manufacturer.
    """
    loaded = controllers.as_made(model.robot_, bench.payload)

    def gravity(q: FloatArray, qd: FloatArray) -> FloatArray:
        held: FloatArray = loaded.gravity(q[None])[0]
        return held

    return gravity


def in_torque(guiding: HandGuiding, arm: Arm) -> Drives:
    """Return the guiding law with torques [N·m], converted with the controller drive gains."""
    scale = arm.gains if guiding.unit == "A" else np.ones_like(arm.gains)
    # With unfiltered velocities, wrists do not come to rest: see hil.control.hand_guiding.
    slow = LowPass(SPEED_HZ, RATE_HZ)
    return lambda q, qd: guiding(q, slow(qd)) * scale


MOST_STRAY_RAD = 0.6
"""Angle between arm and hand at a joint above which the brakes of the arm are applied [rad]."""

ALONE_S = 3.0
"""Time for which the arm is observed after the hand releases it [s]."""

AT_REST_RAD_S = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Led:
    """Result of one hand-guiding run of a control trial.

    Attributes:
        way: Name of the torque law of the drives.
        turn_s: Time for which each joint was guided; the joints were guided one after the other
            [s].
        t: (N,) time of the guided motion [s].
        effort: (N, n) torque of the hand [N·m].
        q: (N, n) position of the arm [rad].
        ran_on: (n,) angle by which each joint moved after the release [rad].
        rest_s: Time from the release until all joints were static [s]; infinite if a joint did not
            become static.
        stopped: Reason why the brakes were applied; empty if the brakes were not applied.
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
        """RMS effort (n,) of the hand at each joint while that joint is guided [N·m]."""
        return self._own_turn(lambda rows: float(np.sqrt(np.mean(rows**2))))

    @property
    def peak(self) -> FloatArray:
        """Maximum effort (n,) of the hand at each joint while that joint is guided [N·m]."""
        return self._own_turn(lambda rows: float(np.abs(rows).max()))

    @property
    def turn(self) -> FloatArray:
        """Index (N,) of the guided joint; n or more while all joints are guided."""
        return np.floor(self.t / self.turn_s)

    def _own_turn(self, figure: Callable[[FloatArray], float]) -> FloatArray:
        n = self.effort.shape[1]
        if self.stopped:
            return np.full(n, np.nan)
        return np.array([figure(self.effort[self.turn == j, j]) for j in range(n)])


def lead(arm: Arm, way: str, drives: Drives | None, leading: Leading, hand: Spring) -> Led:
    """Guide an arm along a path, and release it while it moves.

    Args:
        arm: Simulated arm, static at the beginning of the path.
        way: Name of the torque law of the drives.
        drives: Torque law of the drives; None if the drives give no torque and the brakes are
            applied at the release.
        leading: Path of the hand.
        hand: Stiffness and damping of the hand.
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
            stopped = f"the arm deviated from the hand at {now:.2f} s"
            break
    led = t[: len(efforts)] >= 0
    pieces = (t[: len(efforts)][led], np.array(efforts)[led], np.array(places)[led])
    if stopped:
        return Led(way, leading.turn_s, *pieces, np.full_like(still, np.nan), float("inf"), stopped)
    return Led(way, leading.turn_s, *pieces, *_released(arm, drives))


def _released(arm: Arm, drives: Drives | None) -> tuple[FloatArray, float, str]:
    """Return the motion (n,) [rad] after the release, its duration [s], and a reason.

    The duration ends when the arm is static; the reason states why the brakes were applied.
    """
    released, rest_s, stopped = arm.q.copy(), float("inf"), ""
    if drives is None:
        arm.brake()
    for k in range(round(ALONE_S * RATE_HZ)):
        if drives is None or stopped:
            arm.wait()
        elif not arm.step(drives(arm.q, arm.qd)):
            stopped = "it ran away after the release"
        moving = np.abs(arm.qd).max() > AT_REST_RAD_S
        rest_s = float("inf") if moving else min(rest_s, k / RATE_HZ)
    return np.abs(arm.q - released), rest_s, stopped


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Complete result of a control trial.

    Attributes:
        model: Path of the model folder.
        estimator: Name of the estimator that fitted the model.
        robot: Name of the robot in the station, and name of the station.
        serial: Serial number of the arm that was used in the trial.
        fitted_on: Serial number of the arm on which the model was fitted; empty if unknown.
        joint_names: Names of the n joints.
        payload: Mounted payload.
        seed: Seed of the trajectory.
        friction_share: Share of the dry friction that was compensated during hand guiding.
        pd: PD controller that all feed-forward laws used.
        tracked: Results of the tracking runs, one per feed-forward law.
        leading: Path of the hand.
        led: One hand-guiding run per torque law of the drives.
        seconds: Duration of the trial [s].
        notes: Further notes, the most severe note first.
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
        """Whether the model meets all criteria of a control trial (`hil.control.try_out`)."""
        return all(criterion.met for criterion in judged(self))

    def to_dict(self) -> dict[str, Any]:
        """Return the document that `hil simulate --json` prints."""
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
    """Criterion of a control trial with its result.

    Attributes:
        name: Short name of the criterion, which does not change between versions.
        asked: Requirement.
        met: Whether the criterion is met.
        found: Result of the trial as text.
        mend: Remedy if the criterion is not met.
    """

    name: str
    asked: str
    met: bool
    found: str
    mend: str


ENDED, RESTED, TRACKED, HELPED = "ended", "at rest", "tracking", "hand"


def judged(trial: Trial) -> tuple[Criterion, ...]:
    """Return the results of all criteria for the runs with the model.

    Runs without the model are only a reference and have no criterion.
    """
    return (*_runs(trial), _tracking(trial), _hand(trial))


def _runs(trial: Trial) -> Iterator[Criterion]:
    ways = [run for run in trial.led if run.way in OF_THE_MODEL]
    braked = [f"{run.law}: {run.stopped}" for run in trial.tracked
              if run.stopped and run.law not in controllers.UNIDENTIFIED]  # fmt: skip
    braked += [f"{run.way}: {run.stopped}" for run in ways if run.stopped]
    yield Criterion(
        ENDED, "no run with the model needs the brakes", not braked,
        f"BRAKED, {listed(braked)}" if braked else "no brakes",
        "use a model that was fitted on this arm, or --friction-share 0",
    )  # fmt: skip
    restless = [run.way for run in ways if not np.isfinite(run.rest_s)]
    last = max((run.rest_s for run in ways), default=np.nan)
    yield Criterion(
        RESTED, "the arm comes to rest after the release", not restless,
        f"NOT AT REST with {listed(restless)}" if restless else f"within {last:.1f} s every time",
        "reduce --friction-share, or use a model with more accurate gravity",
    )  # fmt: skip


def _tracking(trial: Trial) -> Criterion:
    better = improvement(trial)
    best = unaided(trial)
    found = (
        f"an error {better:.1f} times smaller than with {best}"
        if np.isfinite(better)
        else "unknown"
    )
    return Criterion(
        TRACKED, "the model tracks better than laws without identification", bool(better > 1.0),
        found, "fit a model with inertia and friction to trajectories of this arm",
    )  # fmt: skip


def _hand(trial: Trial) -> Criterion:
    way = most_help(trial)
    share = relief(trial, way, NOTHING)
    found = f"with {way} {halves(share)}" if np.isfinite(share).all() else "unknown"
    return Criterion(
        HELPED, "effort of the hand at most half of that with the drives off, in every joint",
        bool(np.all(share <= HALF)), found,
        "increase --friction-share (below 1), or use a model with more accurate friction",
    )  # fmt: skip


def unaided(trial: Trial) -> str:
    """Return the name of the best feed-forward law that needs no identification.

    The best law has the least tracking error.

    The returned name is empty if the brakes were applied in all runs with these laws.
    """
    known = {
        run.law: mean_of(run.rms) for run in trial.tracked if run.law in controllers.UNIDENTIFIED
    }
    known = {law: rms for law, rms in known.items() if np.isfinite(rms)}
    return min(known, key=lambda law: known[law], default="")


def improvement(trial: Trial) -> float:
    """Return how much the model reduces the mean RMS tracking error, as a ratio.

    The ratio is the error of the best law without identification divided by the error of the model.
    """
    by_law = {run.law: mean_of(run.rms) for run in trial.tracked}
    return by_law.get(unaided(trial), np.nan) / by_law[controllers.MODEL]


def relief(trial: Trial, of: str, over: str) -> FloatArray:
    """Return the ratios (n,) of the RMS hand efforts with two laws; NaN without a run."""
    by_way = {run.way: run.rms for run in trial.led}
    if of not in by_way or over not in by_way:
        return np.full(len(trial.joint_names), np.nan)
    return by_way[of] / by_way[over]


def most_help(trial: Trial) -> str:
    """Return the name of the most complete hand-guiding law of the model."""
    return [run.way for run in trial.led if run.way in OF_THE_MODEL][-1]


def halves(share: FloatArray) -> str:
    """Return a text that lists the shares (n,), their mean and the joints at or below one half."""
    half = [f"J{j + 1}" for j in np.flatnonzero(share <= HALF)]
    which = "every joint" if len(half) == len(share) else listed(half) or "no joint"
    each = " ".join(f"{100 * value:.0f}" for value in share)
    return f"{each} % (mean {100 * np.mean(share):.0f} %): at most half in {which}"
