"""Checks of the robot: does it stand, feel and think what the plan assumes?"""

from __future__ import annotations

import numpy as np

from hil.arms import arm_names, is_described, load_arm
from hil.core import HilError
from hil.engine.preflight_check import CheckResult, Situation
from hil.robot import Finding, HasChecks, Robot, Status

POSE_TOLERANCE_RAD = 0.01
REST_RAD_S = 0.02
TEMPERATURE_RANGE_C = (-10.0, 80.0)
NO_GUESSES = ("q_limits", "q_min", "q_max", "qd_max", "qdd_max", "capsule")
"""Begin the words for what every plan and interlock rests on: no waiver is for guesses of them."""
OWN = "robot-"
"""Begins the names of checks that the robot itself has made."""


def identity(situation: Situation) -> CheckResult:
    """The robot is the arm the plan was made for, joints in the same order."""
    plan, robot = situation.plan, situation.robot
    model, joints = robot.identity.model, robot.capabilities.joint_names
    differs = {model, plan.robot_model} <= set(arm_names()) and model != plan.robot_model
    return CheckResult(
        "identity",
        not differs and joints == plan.joint_names,
        f"the robot is a {model} with the joints {', '.join(joints)}",
        measured=model,
        limit=plan.robot_model,
        hint=f"the plan is for a {plan.robot_model} with {', '.join(plan.joint_names)}",
    )


def pose(situation: Situation) -> CheckResult:
    """The arm stands where the plan starts, else its first motion would jump."""
    off = np.abs(situation.state["q"] - situation.plan.q_start)
    joint = situation.plan.joint_names[int(off.argmax())]
    return CheckResult(
        "pose",
        bool(off.max() <= POSE_TOLERANCE_RAD),
        f"{joint} is {off.max():.4f} rad from where the plan starts",
        measured=float(off.max()),
        limit=POSE_TOLERANCE_RAD,
        hint="the robot was moved since the plan was made: plan again from here",
    )


def rest(situation: Situation) -> CheckResult:
    """The arm does not move."""
    speed = float(np.abs(situation.state["qd"]).max())
    return CheckResult(
        "rest",
        speed <= REST_RAD_S,
        f"the fastest joint moves at {speed:.4f} rad/s",
        measured=speed,
        limit=REST_RAD_S,
        hint="wait until the arm has come to rest; nothing else may command it",
    )


def fault(situation: Situation) -> CheckResult:
    """The controller reports no fault."""
    state = situation.state
    code, faulty = int(state["fault_code"]), bool(int(state["status"]) & Status.FAULT)
    return CheckResult(
        "fault",
        not faulty and code == 0,
        f"the controller reports fault code {code}, fault bit {'set' if faulty else 'clear'}",
        measured=float(code),
        limit=0.0,
        hint="see the fault at the controller, remove its cause and acknowledge it there",
    )


def payload(situation: Situation) -> CheckResult:
    """The controller takes the load the plan begins with and reads the same back.

    A load that the operator is yet to mount is declared when it is mounted, not before: a
    controller that compensates for a load that is not there lifts the arm.
    """
    # A resumed plan may begin with another load than the first.
    begins = next((step.load for step in situation.plan if step.kind == "payload"), 0)
    first = situation.plan.loads[begins]
    if first.prompt:
        return CheckResult("payload", True, "declared and read back once the load is mounted")
    back = situation.robot.set_payload(first.payload)
    return CheckResult(
        "payload",
        first.payload.agrees_with(back),
        f"declared {first.payload}, the robot reads back {back}",
        measured=back.mass,
        limit=first.payload.mass,
        hint="check the payload settings of the controller",
    )


def temperature(situation: Situation) -> CheckResult:
    """Joint temperatures are believable; a robot that reports none passes."""
    known = situation.state["temperature"][np.isfinite(situation.state["temperature"])]
    if not len(known):
        return CheckResult("temperature", True, "the robot reports no joint temperatures")
    low, high = TEMPERATURE_RANGE_C
    worst = float(known[np.abs(known - (low + high) / 2).argmax()])
    return CheckResult(
        "temperature",
        low <= worst <= high,
        f"joint temperatures are {known.min():.1f} to {known.max():.1f} °C",
        measured=worst,
        limit=high if worst > low else low,
        hint="let the arm cool down or warm up, or see whether a sensor is broken",
    )


def guessed(situation: Situation) -> CheckResult:
    """Nothing about the arm is guessed, unless no real arm is moved: plans go up to its limits."""
    model, robot = situation.plan.robot_model, situation.robot
    guesses = load_arm(model).guessed if is_described(model) else ()
    kept = [word for word in guesses if word.casefold().startswith(NO_GUESSES)]
    words = ", ".join(guesses)
    never = f"; a waiver is not for {', '.join(kept)}" if kept else ""
    mocked = robot.capabilities.clock == "virtual" or robot.identity.driver == "mock"
    told = f"the description of the arm is guessed in {words}" if words else "nothing is guessed"
    return CheckResult(
        "guessed",
        mocked or not words,
        told + (", which moves a mock alone" if words and mocked else ""),
        measured=words,
        limit="",
        hint=f"put in what the maker says, and take it out of `guessed` in {model}{never}",
        waivable=not kept,
    )


def own_checks(robot: Robot) -> list[CheckResult]:
    """What a robot that opts into `hil.robot.HasChecks` has found out about itself."""
    if not isinstance(robot, HasChecks):
        return []
    try:
        findings = list(robot.checks())
    except HilError as error:
        findings = [Finding("checks", False, error.message, hint=error.hint)]
    except Exception as error:  # a driver may raise anything, and none of it means "go"
        told = f"the robot's own checks broke: {type(error).__name__}: {error}"
        findings = [Finding("checks", False, told, hint="this is a bug in the driver")]
    return [
        CheckResult(f"{OWN}{each.name}", each.passed, each.message, each.measured, each.limit,
                    each.hint)
        for each in findings
    ]  # fmt: skip
