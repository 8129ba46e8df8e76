"""Confirmation that a real robot may move: the facts of the motion are shown, the answer recorded.

Mocks, loopback addresses and virtual buses need no confirmation (`hil.robot.Address.real`). A real
robot moves if the operator types its name at the console (`TypedName`), or if the call, the file or
the form that starts the run names it (`Granted`); otherwise it is not even connected to
(`Unconfirmed`). The `Gate` of a run asks twice: before connecting, whether the robot can be
confirmed at all, and before motion, whether these facts are confirmed. An earlier confirmation
holds as long as robot, address and payload are the same and the motion goes no further and no
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
    """The facts about a motion that an operator has to know before a robot moves.

    Attributes:
        experiment: Name of the experiment; distinguishes the motions of a series.
        robot: Name in its station.
        model, driver: As the station says.
        address: Address that its commands are sent to.
        identity: Model, serial number and firmware of the controller; empty before connecting.
        loads: Loads in the order of the plan.
        speed_share: Share of the speeds that the spec asks for; below 1 in commissioning runs.
        speed_rad_s: Largest speed of any joint [rad/s].
        speed_limit_rad_s: Largest joint speed that the robot allows [rad/s].
        swept: Duration, ranges of the joints, boxes of tool and elbow.
        checklist: Conditions that the operator has to check before the robot moves.
        changed: Differences from what was confirmed before, each in a few words; shown only.
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
        """Return plain text, one line per fact."""
        return aligned(self.rows())

    def rows(self) -> list[tuple[str, str]]:
        """Return the facts in words, each with its label."""
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
        """Return the JSON form; SI units."""
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
        """sha256 of the JSON form."""
        return digest_of(self.to_dict())


def _load_words(load: LoadStep) -> str:
    p = load.payload
    if not p.mass:
        return "none"
    return f"{p.mass:g} kg at ({', '.join(f'{1000 * x:g}' for x in p.com)}) mm"


def motion_facts(experiment: Experiment, robot: Robot, plan: Plan) -> MotionFacts:
    """Return what has to be confirmed before a plan is executed.

    Args:
        experiment: Says which robot of which station.
        robot: Need not be connected; the plan then begins in another pose than the run will.
        plan: Exactly what is executed.
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
    """Return the loads of a plan as `start.json` has them."""
    return [{"mass_kg": one.payload.mass, "com_m": list(one.payload.com)} for one in loads]


def digest_of(facts: Mapping[str, Any]) -> str:
    """Return the sha256 of facts in their JSON form."""
    text = json.dumps(facts, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def facts_of_all(motions: Sequence[Mapping[str, Any]]) -> Document:
    """Return the facts that confirm several motions, those of a series, at once.

    Args:
        motions: `MotionFacts.to_dict` of each, in the order of execution.

    Returns:
        What they have in common; of more than one also all of them as `motions`.
    """
    first = motions[0] if motions else {}
    facts = {key: value for key, value in first.items() if all(value == m[key] for m in motions)}
    return facts | ({"motions": list(motions)} if len(motions) > 1 else {})


class Gate:
    """Asks in a run whether its robot may move.

    Args:
        experiment: Says which robot of which station.
        confirm: Confirms the motion of a real robot.
        confirmed: Facts that were confirmed before; they hold unless robot, address or payload
            has changed, or the motion goes further or is faster.
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
        """Raise `NotConfirmed` if a real robot could not be confirmed later.

        Args:
            robot: Not yet connected: its options alone decide whether it is real.
        """
        name, self._at = self._experiment.spec.robot, address_of(robot)
        if self._at.real and not self._holds({"robot": name, "address": self._at.text}):
            self._confirm.admit(name, self._at.text)

    def facts(self, robot: Robot, plan: Plan) -> MotionFacts | None:
        """Return what has to be confirmed before a plan is executed; None if nothing has to be.

        Args:
            robot: Admitted and connected, at rest.
            plan: Exactly what is executed.
        """
        if not self._at.real:
            return None
        facts = replace(motion_facts(self._experiment, robot, plan), address=self._at.text)
        shown = facts.to_dict()
        same = self._holds({key: shown[key] for key in ("robot", "address", "loads")})
        changed = differences(self._confirmed, shown)
        return None if same and not changed else replace(facts, changed=tuple(changed))

    def confirmation(self, robot: Robot, plan: Plan) -> Document | None:
        """Return the record of the confirmation of a motion; None if none is needed.

        Args:
            robot: Admitted and connected, at rest.
            plan: Exactly what is executed.

        Raises:
            NotConfirmed: The motion was not confirmed.
        """
        facts = self.facts(robot, plan)
        if facts is None:
            return None
        try:
            answer = self._confirm(facts, lambda: _keep_reading(robot))
        except NotConfirmed as refused:
            if not facts.changed:
                raise
            message = f"{refused.message}; not as confirmed before: {'; '.join(facts.changed)}"
            raise NotConfirmed(message, hint=refused.hint) from None
        return {**answer, "time": utc_now(), "facts": facts.to_dict(), "digest": facts.digest}

    def _holds(self, now: Mapping[str, Any]) -> bool:
        """Return whether the earlier confirmation has the same facts."""
        return all(self._confirmed.get(key) == value for key, value in now.items())


def _keep_reading(robot: Robot) -> None:
    """Read the robot while the facts are read: its driver must neither fill up nor time out."""
    robot.read()
    if isinstance(robot, HasTopics):
        robot.drain()


class Confirm(Protocol):
    """Confirms that a real robot may move."""

    def admit(self, robot: str, address: str) -> None:
        """Raise `NotConfirmed` if this robot cannot be confirmed; asked before connecting."""

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """Return how and by whom the motion was confirmed.

        Args:
            facts: Of the motion that is about to begin.
            meanwhile: Called while waiting; keeps reading the robot.

        Raises:
            NotConfirmed: It was not.
        """


@dataclass(frozen=True, slots=True)
class Unconfirmed:
    """The default: no real robot moves.

    Attributes:
        hint: How the motion is confirmed here; by default as in a call in Python.
    """

    hint: str = ""

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        raise NotConfirmed(
            f"{robot} at {address} is a real robot, and its motion was not confirmed",
            hint=self.hint or f"name it in the call: robot={robot!r}",
        )

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`."""
        self.admit(facts.robot, facts.address)
        return {}


TYPED = "typed"


@dataclass(frozen=True, slots=True)
class TypedName:
    """The operator types the name of the robot at the console.

    Attributes:
        console: The terminal.
        who: Recorded; by default the user of this process.
    """

    console: Console
    who: str = ""

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        if not self.console.present:
            raise NotConfirmed(
                f"{robot} at {address} is a real robot, and its motion cannot be confirmed: no "
                "terminal is attached",
                hint="start it in a terminal; in a script confirm with --yes; to rehearse, start "
                "a mock robot: hil mock",
            )

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`."""
        self.admit(facts.robot, facts.address)
        self._show(facts)
        meanwhile()
        self.console.forget_typed()
        self.console.say(ask=f"type {facts.robot} to move, Enter to leave it where it is: ")
        typed = typed_line(self.console, meanwhile)
        if typed != facts.robot:
            why = f"{typed!r} was typed" if typed else "its name was not typed"
            raise NotConfirmed(
                f"{facts.robot} was not confirmed ({why}); nothing has moved",
                hint=f"run it again and type {facts.robot}",
            )
        return {"how": TYPED, "by": self.who or this_user()}

    def _show(self, facts: MotionFacts) -> None:
        must = [f"  [ ] {item}" for item in facts.checklist]
        about = ["", "A real robot is about to move:", *(f"  {line}" for line in facts.lines())]
        self.console.show([*about, *(["Its name also confirms that:", *must] if must else [])])


ANSWER_WITHIN_S = 300.0
"""Longest time for an answer: the robot is held meanwhile, and the facts are about the pose it
stands in [s]."""

LOOK_EVERY_S = 0.05


def typed_line(console: Console, meanwhile: Callable[[], object] = lambda: None) -> str:
    """Return the line typed within `ANSWER_WITHIN_S`; empty without one.

    Args:
        console: The terminal.
        meanwhile: Called while waiting.
    """
    deadline = time.monotonic() + ANSWER_WITHIN_S
    while console.present and time.monotonic() < deadline:
        if (line := console.line(LOOK_EVERY_S)) is not None:
            return line
        meanwhile()
    return ""


def was_shown(confirmation: Mapping[str, Any] | None) -> bool:
    """Return whether the operator has just read the facts at the console."""
    return confirmation is not None and confirmation["how"] == TYPED


@dataclass(frozen=True, slots=True)
class Granted:
    """Confirmed beforehand, for the facts named then and no others.

    Attributes:
        how: Recorded: `--yes`, `robot=`, `dashboard`, `armed`.
        who: Recorded; by default the user of this process.
        facts: What was confirmed, as in `MotionFacts.to_dict`; missing keys may have any value. Of
            a series also `motions`, the facts of each experiment in order.
        more: Recorded, too, such as when and where it was confirmed.
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
    """Return the differences from what was confirmed for this experiment of a series.

    The arm may stand anywhere where the experiments before it went, so that the way to the first
    pose may sweep what they swept; payload and speed are its own.
    """
    different = [f"the experiment {now['experiment']} was not shown"]
    for i, one in enumerate(motions):
        if one["experiment"] == now["experiment"]:
            union = {"swept": _union_of_swept([each["swept"] for each in motions[: i + 1]])}
            if not (different := differences({**one, **union}, now)):
                break
    return different


def _union_of_swept(spaces: Sequence[Mapping[str, Any]]) -> Document:
    """Return the ranges of the joints and the boxes that contain those of several motions."""
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
    """Return the confirmation of a file: `how`, `by` and `facts`.

    Raises:
        DataError: It is no such file.
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
    """Return a short text per difference from what was confirmed.

    Only keys of both are compared. A motion may sweep less than was confirmed and be slower;
    the identity and the checklist of the robot are not compared.

    Args:
        confirmed: As in `MotionFacts.to_dict`, or part of it.
        now: The same of the motion that is about to begin.
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
"""A confirmation covers motions that go so much further: an arm drifts a little while it stands."""


def _beyond_confirmed(confirmed: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    changes = []
    for was, is_ in zip(confirmed["joints"], now["joints"], strict=False):
        low, high = was["min_rad"] - JOINT_SLACK_RAD, was["max_rad"] + JOINT_SLACK_RAD
        if is_["min_rad"] < low or is_["max_rad"] > high:
            changes.append(f"{is_['name']} goes {_range(is_)}, confirmed were {_range(was)}")
    for part in ("tool", "elbow"):
        was, is_ = confirmed[part], now[part]
        below = np.array(is_["min_m"]) < np.array(was["min_m"]) - BOX_SLACK_M
        above = np.array(is_["max_m"]) > np.array(was["max_m"]) + BOX_SLACK_M
        if (below | above).any():
            changes.append(f"the {part} leaves the confirmed box")
    return changes


def _range(joint: Mapping[str, Any]) -> str:
    return f"{math.degrees(joint['min_rad']):.0f}° to {math.degrees(joint['max_rad']):.0f}°"
