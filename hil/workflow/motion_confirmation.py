"""Confirmation that a real robot may move: show the facts of the motion, record the answer.

Mocks, loopback addresses and virtual buses need no confirmation of motion
(`hil.robot.Address.real`). A real robot moves if the operator types its name at the console
(`TypedName`), or if the call, the file or the form that starts the run names the robot (`Granted`).
Without either confirmation, hil does not even connect to the robot (`Unconfirmed`). The `Gate` of a
run checks twice: before connecting, whether the robot can be confirmed at all, and before the
motion, whether the facts of this motion are confirmed. An earlier confirmation of motion stays
valid while robot, address and payload are the same and the motion neither sweeps more space nor is
faster (`differences`).
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.arms import load_arm
from hil.core import DataError, NotConfirmed, read_json
from hil.planning import Experiment, LoadStep, Plan, Swept, aligned, swept
from hil.recording import operator as this_user
from hil.recording import utc_now
from hil.robot import Address, HasTopics, Robot, address_of
from hil.workflow.console import Console

Document = dict[str, Any]


@dataclass(frozen=True)
class MotionFacts:
    """Facts about a motion that an operator has to know before a robot moves.

    Attributes:
        experiment: Name of the experiment, which distinguishes the motions of a series.
        robot: Name of the robot in its station.
        model, driver: Model and driver of the robot in the station file.
        address: Address to which the commands of the robot are sent.
        identity: Model, serial number and firmware of the controller; empty before connecting.
        loads: Payloads in the order in which the plan mounts them.
        speed_share: Ratio of executed speed to the speed of the spec; below 1 in commissioning
            runs.
        speed_rad_s: Largest speed of any joint [rad/s].
        speed_limit_rad_s: Largest joint speed that the robot allows [rad/s].
        swept: Duration of the motion, range of each joint, and bounding boxes of tool and elbow.
        checklist: Conditions that the operator has to check before the robot moves.
        changed: Short texts, one for each difference from an earlier confirmation; only displayed.
    """

    experiment: str
    robot: str
    model: str
    driver: str
    address: str
    identity: str
    loads: tuple[LoadStep, ...]
    speed_share: float
    speed_rad_s: float
    speed_limit_rad_s: float
    swept: Swept
    checklist: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the facts of the motion as plain text, one line per fact."""
        return aligned(self.rows())

    def rows(self) -> list[tuple[str, str]]:
        """Return the facts of the motion as texts, each with its label."""
        kind = f"{self.model}, driver {self.driver}"
        share = "" if self.speed_share == 1.0 else f" ({100 * self.speed_share:.4g} % of the spec)"
        most, limit = (math.degrees(v) for v in (self.speed_rad_s, self.speed_limit_rad_s))
        rows = [
            ("robot", f"{self.robot} ({kind})"),
            ("address", self.address),
            *([("controller", self.identity)] if self.identity else []),
            ("payload", "; then ".join(_load_words(load) for load in self.loads)),
            ("speed", f"joints up to {most:.3g}°/s{share}; the robot allows {limit:.3g}°/s"),
        ]
        return [*rows, *self.swept.rows(), *(("not as confirmed", text) for text in self.changed)]

    def to_dict(self) -> Document:
        """Return the JSON form of the facts, in SI units."""
        return {
            "experiment": self.experiment,
            "robot": self.robot,
            "model": self.model,
            "driver": self.driver,
            "address": self.address,
            "identity": self.identity,
            "loads": loads_document(self.loads),
            "speed_share": self.speed_share,
            "speed_rad_s": self.speed_rad_s,
            "speed_limit_rad_s": self.speed_limit_rad_s,
            "swept": self.swept.to_dict(),
            "checklist": list(self.checklist),
        }

    @cached_property
    def digest(self) -> str:
        """SHA-256 digest of the JSON form of the facts."""
        return digest_of(self.to_dict())


def _load_words(load: LoadStep) -> str:
    p = load.payload
    if not p.mass:
        return "none"
    return f"{p.mass:g} kg at ({', '.join(f'{1000 * x:g}' for x in p.com)}) mm"


def motion_facts(experiment: Experiment, robot: Robot, plan: Plan) -> MotionFacts:
    """Return the facts that have to be confirmed before a plan is executed.

    Args:
        experiment: Experiment, which names robot and station.
        robot: Robot, connected or not; if the robot is not connected, the plan of a run starts in a
            different pose.
        plan: Exactly the plan that will be executed.
    """
    commissioning, model = experiment.commissioning, experiment.robot.model
    return MotionFacts(
        experiment=experiment.spec.name,
        robot=experiment.spec.robot,
        model=model,
        driver=experiment.robot.driver,
        address=address_of(robot).text,
        identity=_identity_words(robot),
        loads=plan.loads,
        speed_share=commissioning.speed if commissioning else 1.0,
        speed_rad_s=float(plan.extremes.qd_max.max()),
        speed_limit_rad_s=float(np.max(robot.limits.qd_max)),
        swept=swept(plan, load_arm(model)),
        checklist=experiment.robot.checklist,
    )


def _identity_words(robot: Robot) -> str:
    try:
        identity = robot.identity
    except ConnectionError:
        return ""
    return f"{identity.model}, serial number {identity.serial}, {identity.firmware}"


def loads_document(loads: Sequence[LoadStep]) -> list[Document]:
    """Return the payloads of a plan in the format of `start.json`."""
    return [{"mass_kg": one.payload.mass, "com_m": list(one.payload.com)} for one in loads]


def digest_of(facts: Mapping[str, Any]) -> str:
    """Return the SHA-256 digest of motion facts in their JSON form."""
    text = json.dumps(facts, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def facts_of_all(motions: Sequence[Mapping[str, Any]]) -> Document:
    """Return the combined facts for confirming several motions of a series at the same time.

    Args:
        motions: Result of `MotionFacts.to_dict` for each motion, in the order of execution.

    Returns:
        Dict of the facts that all motions have in common. If there are several motions, the key
        `motions` contains the separate facts of each motion.
    """
    first = motions[0] if motions else {}
    facts = {key: value for key, value in first.items() if all(value == m[key] for m in motions)}
    return facts | ({"motions": list(motions)} if len(motions) > 1 else {})


class Gate:
    """Check in a run that the robot of the run is allowed to move.

    Args:
        experiment: Experiment, which names robot and station.
        confirm: Function that confirms the motion of a real robot.
        confirmed: Facts of an earlier confirmation; valid unless robot, address or payload has
            changed or the motion sweeps more space or is faster.
    """

    def __init__(
        self,
        experiment: Experiment,
        confirm: Confirm,
        confirmed: Mapping[str, Any] | None = None,
    ) -> None:
        self._experiment, self._confirm = experiment, confirm
        self._confirmed = confirmed or {}
        self._at = Address("unknown")

    def admit(self, robot: Robot) -> None:
        """Raise `NotConfirmed` if the motion of a real robot could not be confirmed later.

        Args:
            robot: Robot that is not connected yet; only its options decide whether the robot is
                real.
        """
        name, self._at = self._experiment.spec.robot, address_of(robot)
        if self._at.real and not self._holds({"robot": name, "address": self._at.text}):
            self._confirm.admit(name, self._at.text)

    def facts(self, robot: Robot, plan: Plan) -> MotionFacts | None:
        """Return the facts to confirm before a plan is executed; None if no confirmation is needed.

        Args:
            robot: Connected robot that `admit` has accepted, at standstill.
            plan: Exactly the plan that will be executed.
        """
        if not self._at.real:
            return None
        facts = replace(motion_facts(self._experiment, robot, plan), address=self._at.text)
        shown = facts.to_dict()
        same = self._holds({key: shown[key] for key in ("robot", "address", "loads")})
        changed = differences(self._confirmed, shown)
        return None if same and not changed else replace(facts, changed=tuple(changed))

    def confirmation(self, robot: Robot, plan: Plan) -> Document | None:
        """Return the record of the confirmation of a motion; None if no confirmation is needed.

        Args:
            robot: Connected robot that `admit` has accepted, at standstill.
            plan: Exactly the plan that will be executed.

        Raises:
            NotConfirmed: The operator did not confirm the motion.
        """
        facts = self.facts(robot, plan)
        if facts is None:
            return None
        try:
            answer = self._confirm(facts, lambda: _keep_reading(robot))
        except NotConfirmed as refused:
            if not facts.changed:
                raise
            message = (
                f"{refused.message}; changed since the earlier confirmation: "
                f"{'; '.join(facts.changed)}"
            )
            raise NotConfirmed(message, hint=refused.hint) from None
        return {**answer, "time": utc_now(), "facts": facts.to_dict(), "digest": facts.digest}

    def _holds(self, now: Mapping[str, Any]) -> bool:
        """Return whether the earlier confirmation contains every value of `now`."""
        return all(self._confirmed.get(key) == value for key, value in now.items())


def _keep_reading(robot: Robot) -> None:
    """Keep reading the robot while the operator reads the facts of the motion.

    Without these reads, the receive buffer of the driver overflows or the connection times out.
    """
    robot.read()
    if isinstance(robot, HasTopics):
        robot.drain()


class Confirm(Protocol):
    """Interface of a confirmation that a real robot may move."""

    def admit(self, robot: str, address: str) -> None:
        """Raise `NotConfirmed` if this robot cannot be confirmed; called before connecting."""

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """Return the method of the confirmation and the user who confirmed the motion.

        Args:
            facts: Facts of the motion that is about to begin.
            meanwhile: Function that is called repeatedly while the operator decides; it keeps
                reading the robot.

        Raises:
            NotConfirmed: The operator did not confirm the motion.
        """


@dataclass(frozen=True, slots=True)
class Unconfirmed:
    """Default confirmation, which refuses every motion of a real robot.

    Attributes:
        hint: Hint on how to confirm the motion; by default the hint for a call in Python.
    """

    hint: str = ""

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        raise NotConfirmed(
            f"{robot} at {address} is a real robot, and its motion was not confirmed",
            hint=self.hint or f"name the robot in the call: robot={robot!r}",
        )

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`."""
        self.admit(facts.robot, facts.address)
        return {}


TYPED = "typed"


@dataclass(frozen=True, slots=True)
class TypedName:
    """Confirmation by an operator who types the name of the robot at the console.

    Attributes:
        console: Terminal.
        who: Name of the operator, for the record; by default the user of this process.
    """

    console: Console
    who: str = ""

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        if not self.console.present:
            raise NotConfirmed(
                f"{robot} at {address} is a real robot, and its motion cannot be confirmed: no "
                "terminal is attached",
                hint="start the command in a terminal; in a script, confirm with --yes; to "
                "rehearse, start a mock robot: hil mock",
            )

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`."""
        self.admit(facts.robot, facts.address)
        self._show(facts)
        meanwhile()
        self.console.forget_typed()
        self.console.say(ask=f"type {facts.robot} to move this robot, or press Enter to cancel: ")
        typed = typed_line(self.console, meanwhile)
        if typed != facts.robot:
            why = f"{typed!r} was typed" if typed else "its name was not typed"
            raise NotConfirmed(
                f"{facts.robot} was not confirmed ({why}); nothing has moved",
                hint=f"run the command again and type {facts.robot}",
            )
        return {"how": TYPED, "by": self.who or this_user()}

    def _show(self, facts: MotionFacts) -> None:
        must = [f"  [ ] {item}" for item in facts.checklist]
        about = ["", "A real robot is about to move:", *(f"  {line}" for line in facts.lines())]
        if must:
            about += ["Typing its name also confirms that:", *must]
        self.console.show(about)


ANSWER_WITHIN_S = 300.0
"""Maximum time to wait for the typed name of the robot [s].

The waiting time is limited because the robot is leased meanwhile, and because the facts of the
motion depend on the present pose of the robot.
"""

LOOK_EVERY_S = 0.05


def typed_line(console: Console, meanwhile: Callable[[], object] = lambda: None) -> str:
    """Return the line typed within `ANSWER_WITHIN_S`; empty if no line was typed.

    Args:
        console: Terminal.
        meanwhile: Function that is called repeatedly while the operator types.
    """
    deadline = time.monotonic() + ANSWER_WITHIN_S
    while console.present and time.monotonic() < deadline:
        if (line := console.line(LOOK_EVERY_S)) is not None:
            return line
        meanwhile()
    return ""


def was_shown(confirmation: Mapping[str, Any] | None) -> bool:
    """Return whether the operator has just read the facts of the motion at the console."""
    return confirmation is not None and confirmation["how"] == TYPED


@dataclass(frozen=True, slots=True)
class Granted:
    """Confirmation that was given in advance and is valid only for the facts that it contains.

    Attributes:
        how: Method of the confirmation, for the record: `--yes`, `robot=`, `dashboard` or `armed`.
        who: Name of the user who confirmed, for the record; by default the user of this process.
        facts: Confirmed facts of the motion, as in `MotionFacts.to_dict`; a missing key allows any
            value. For a series, the key `motions` of the facts contains the facts of each
            experiment in order.
        more: Additional entries of the record, such as time and place of the confirmation.
    """

    how: str
    who: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    more: Mapping[str, Any] = field(default_factory=dict)

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        self._require_same(differences(self.facts, {"robot": robot, "address": address}), robot)

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`."""
        now = facts.to_dict()
        different = differences(self.facts, now)
        if not different and "motions" in self.facts:
            different = _differences_in_series(self.facts["motions"], now)
        self._require_same(different, facts.robot)
        return {"how": self.how, "by": self.who or this_user(), **self.more}

    def _require_same(self, different: Sequence[str], robot: str) -> None:
        if different:
            raise NotConfirmed(
                f"the confirmation ({self.how}) does not cover this motion of {robot}: "
                f"{'; '.join(different)}",
                hint="check the facts of this motion, and confirm them",
            )


def _differences_in_series(
    motions: Sequence[Mapping[str, Any]], now: Mapping[str, Any]
) -> list[str]:
    """Return the differences between present and confirmed facts of an experiment of a series.

    The arm may stand at any pose that the earlier experiments of the series reached, so the motion
    to the first pose is allowed to sweep the space of the earlier experiments. Payload and speed
    must equal the confirmed values of the experiment itself.
    """
    different = [f"the experiment {now['experiment']} was not shown for confirmation"]
    for i, one in enumerate(motions):
        if one["experiment"] == now["experiment"]:
            union = {"swept": _union_of_swept([each["swept"] for each in motions[: i + 1]])}
            if not (different := differences({**one, **union}, now)):
                break
    return different


def _union_of_swept(spaces: Sequence[Mapping[str, Any]]) -> Document:
    """Return the joint ranges and boxes that enclose the ranges and boxes of several motions."""
    joints = [
        {
            "name": same[0]["name"],
            "min_rad": min(one["min_rad"] for one in same),
            "max_rad": max(one["max_rad"] for one in same),
        }
        for same in zip(*(each["joints"] for each in spaces), strict=True)
    ]
    boxes = {
        part: {
            "min_m": np.min([each[part]["min_m"] for each in spaces], axis=0).tolist(),
            "max_m": np.max([each[part]["max_m"] for each in spaces], axis=0).tolist(),
        }
        for part in ("tool", "elbow")
    }
    return {"joints": joints, **boxes}


def granted_in(path: Path) -> Granted:
    """Return the confirmation that a file contains under the keys `how`, `by` and `facts`.

    Raises:
        DataError: The file does not contain a confirmation.
    """
    document = read_json(path)
    facts = document.get("facts")
    texts = all(isinstance(document.get(key), str) for key in ("how", "by"))
    motions = facts.get("motions", []) if isinstance(facts, dict) else []
    whole = isinstance(motions, list) and all(
        isinstance(one, dict) and {"experiment", "swept"} <= one.keys() for one in motions
    )
    if not (texts and whole and facts and facts.get("robot") and facts.get("address")):
        raise DataError(
            f"{path} is not a confirmation: it needs how, by, and facts with robot and address",
            hint="start the run from the dashboard's start page",
        )
    return Granted(document["how"], document["by"], facts)


def differences(confirmed: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return a short text for each difference between present and confirmed facts.

    Only keys that both sets of facts contain are compared. A motion may sweep less space than
    confirmed and may be slower. Identity and checklist of the robot are not part of the comparison.

    Args:
        confirmed: Confirmed facts of a motion, as in `MotionFacts.to_dict`, or a part of these
            facts.
        now: Facts of the motion that is about to begin, in the same format.
    """
    both = confirmed.keys() & now.keys()
    equal = [key for key in ("robot", "model", "driver", "address", "loads") if key in both]
    changes = [
        f"{key} was {_in_words(key, confirmed[key])}, is {_in_words(key, now[key])}"
        for key in equal
        if confirmed[key] != now[key]
    ]
    if "speed_rad_s" in both and now["speed_rad_s"] > confirmed["speed_rad_s"] * 1.01:
        was, is_ = (f"{math.degrees(one['speed_rad_s']):.3g}°/s" for one in (confirmed, now))
        changes.append(f"joint speed was {was}, is {is_}")
    if "swept" in both:
        changes += _beyond_confirmed(confirmed["swept"], now["swept"])
    return changes


def _in_words(key: str, value: Any) -> str:
    if key != "loads":
        return str(value)
    return " then ".join(f"{one['mass_kg']:g} kg" for one in value or []) or "none"


JOINT_SLACK_RAD = math.radians(1.0)

BOX_SLACK_M = 0.01
"""Distance by which a motion may exceed the confirmed boxes [m], because a static arm drifts."""


def _beyond_confirmed(confirmed: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    changes = []
    for was, is_ in zip(confirmed["joints"], now["joints"], strict=False):
        low, high = was["min_rad"] - JOINT_SLACK_RAD, was["max_rad"] + JOINT_SLACK_RAD
        if is_["min_rad"] < low or is_["max_rad"] > high:
            changes.append(f"{is_['name']} moves {_range(is_)}, but {_range(was)} was confirmed")
    for part in ("tool", "elbow"):
        was, is_ = confirmed[part], now[part]
        below = np.array(is_["min_m"]) < np.array(was["min_m"]) - BOX_SLACK_M
        above = np.array(is_["max_m"]) > np.array(was["max_m"]) + BOX_SLACK_M
        if (below | above).any():
            changes.append(f"the {part} leaves the confirmed box")
    return changes


def _range(joint: Mapping[str, Any]) -> str:
    return f"{math.degrees(joint['min_rad']):.0f}° to {math.degrees(joint['max_rad']):.0f}°"
