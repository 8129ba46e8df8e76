"""The person at the robot: asked to mount loads, asked to confirm motion, and heard at pauses.

Prompts are answered at the console this process was started from, from another terminal
(`hil answer`), or from a file written before the run, for CI and for robots that load themselves::

    - {prompt: Remove everything, answer: yes, who: gripper}
    - {prompt: 3 kg cylinder, answer: yes, who: gripper}

in the order in which the run asks; `prompt` is a part of what it says.

Motion of a real robot is confirmed: its facts are shown, and the answer is recorded. Mocks,
loopback addresses and virtual buses need no confirmation (`hil.robot.Address.real`). A real robot
moves when the operator types its name at the console, or when the call, the file or the form that
starts the run names it; otherwise it is not even connected.

A `Desk` is all of it together: who confirms, who answers, and who ends a pause.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import select
import shutil
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from textwrap import wrap
from typing import Any, Protocol

import numpy as np

from hil.arms import load_arm
from hil.core import (
    DataError,
    NotConfirmed,
    PreflightFailed,
    Source,
    SpecError,
    did_you_mean,
    read_json,
    read_source,
    refuse,
    shown,
)
from hil.engine import NOBODY, GoOn, Prompt, Reply
from hil.planning import Experiment, LoadStep, Plan, Swept, aligned, swept
from hil.recording import operator as this_user
from hil.recording import utc_now
from hil.robot import Address, HasTopics, Robot, address_of

WAIT_S = 0.05

NEW_PAUSE_AFTER_S = 3.0
"""Not looked for so long, a pause is another one: what was typed before does not end it [s]."""

YES, NO = ("y", "yes"), ("n", "no")


class ConsoleOperator:
    """The engine's `Prompt` for a run with somebody beside it.

    Args:
        who: Recorded for answers given at the console.
        console: Where this process was started.
        elsewhere: Whether all answers come from elsewhere: nobody sits at the console, and a mock
            is asked like any other robot.
    """

    def __init__(
        self,
        who: str = "operator",
        console: Console | None = None,
        *,
        elsewhere: bool = False,
    ) -> None:
        self._who = who
        self._console = console or Console(read=not elsewhere)
        self.elsewhere = elsewhere
        self._run: Path | None = None
        self._asking = threading.Lock()
        self._asked, self._number = "", 0
        self._answer: Reply | None = None
        self._looked = -NEW_PAUSE_AFTER_S

    @property
    def attended(self) -> bool:
        """Whether there is a console that somebody may sit at."""
        return self._console.present

    def listen(self, run: Path | None) -> None:
        """From now on answers to this run's prompts also come from elsewhere; None ends that."""
        self._run = run
        if run is not None:
            self._number = 0  # of its prompts

    def answer(self, yes: bool, who: str, prompt: str, asked: int = 0) -> str:
        """Answer from elsewhere, on another thread; returns why it was not taken, or nothing.

        Args:
            yes: Whether it is done; a no stops the run.
            who: Recorded.
            prompt: The text that is answered; an answer to another one is not taken.
            asked: Its number among the prompts of the run: the next one may have the same text.
                0 where only the text is known.
        """
        with self._asking:
            if not self._asked:
                return "the run asks nothing"
            if prompt != self._asked:
                return f"the run asks something else now: {self._asked!r}"
            if asked not in (0, self._number):
                return f"prompt {asked} is over, the run asks its prompt {self._number} now"
            if yes and self._answer is not None:  # a no, which stops the run, always counts
                return f"{self._answer.words} already"
            self._answer = Reply(yes, who)
            return ""

    def __call__(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        """Ask and wait.

        Args:
            text: What is to be done and confirmed.
            meanwhile: Called while waiting; see `hil.engine.Prompt`.

        Returns:
            Who answered what; `NOBODY` when nobody could.
        """
        with self._asking:
            self._number += 1  # also where nobody can answer: the engine counts it, too
        if not (self.attended or self._run):
            return NOBODY
        with self._asking:
            self._asked, self._answer = text, None
        try:
            meanwhile()  # lets the last progress line be written before the question
            self._console.forget_typed()
            self._ask(text)
            return self._wait(text, meanwhile)
        finally:
            with self._asking:
                self._asked = ""

    def goes_on(self) -> str:
        """Who ended a pause by pressing Enter at the console, else nothing; does not wait."""
        now = time.monotonic()
        if now - self._looked > NEW_PAUSE_AFTER_S:
            self._console.forget_typed()
        self._looked = now
        pressed = self.attended and self._console.line(0.0) is not None
        return self._who if pressed else ""

    def _ask(self, text: str) -> None:
        elsewhere = f"hil answer {self._run} yes" if self._run else ""
        if not self.attended:
            self._console.say(text, f"waiting for: {elsewhere}")
        else:
            hint = [f"(or, from another terminal: {elsewhere})"] if elsewhere else []
            self._console.say(text, *hint, ask="Type yes when done, no to stop: ")

    def _wait(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        pausing: object = ""
        while (reply := self._settled()) is None:
            line = self._console.line(WAIT_S)
            if line is not None and line.lower() in YES + NO:
                typed = Reply(line.lower() in YES, self._who)
                return self._settled(typed) or typed
            if line is not None:
                self._console.say(ask="Please type yes or no: ")
            if not (self.attended or self._run):  # the terminal has gone
                return NOBODY
            before, pausing = pausing, meanwhile()
            if pausing and not before:
                self._console.say(f"pausing once the question is answered: {pausing}")
                self._ask(text)
        self._console.say(f"{reply.words} from another terminal")
        return reply

    def _settled(self, typed: Reply | None = None) -> Reply | None:
        """What counts of all that was answered by now, if anything was; nothing else is taken then.

        A no that was taken from elsewhere stops the run, whatever is typed in that moment.
        """
        with self._asking:
            given = [reply for reply in (self._answer, typed) if reply is not None]
            if not given:
                return None
            self._asked = ""
            return next((reply for reply in given if not reply.yes), given[0])


def mock_mounts(text: str, meanwhile: Callable[[], object]) -> Reply:
    """A robot on a virtual clock is a mock: it mounts the declared load when it is told to."""
    return Reply(yes=True, who="mock")


def prompt_on(robot: Robot, prompt: Prompt) -> Prompt:
    """Who answers on this robot: a mock by itself, unless others are said to answer."""
    others = isinstance(prompt, ScriptedOperator) or (
        isinstance(prompt, ConsoleOperator) and prompt.elsewhere
    )
    return mock_mounts if robot.capabilities.clock == "virtual" and not others else prompt


def prompts_of(plan: Plan) -> list[str]:
    """Everything a plan asks, in order."""
    asked = (plan.loads[step.load].prompt for step in plan if step.kind == "payload")
    return [text for text in asked if text]


def require_attended(plan: Plan, prompt: Prompt, *, resumed: bool = False) -> None:
    """Refuse, before anything moves, a run that would wait for an answer nobody can give.

    Args:
        plan: What is about to be executed.
        prompt: Who answers, from `prompt_on`.
        resumed: Whether part of what the answers are for may be behind us.

    Raises:
        PreflightFailed: It asks something, and there is no console.
        SpecError: The answers written down are not those to its prompts.
    """
    asked = prompts_of(plan)
    if isinstance(prompt, ScriptedOperator):
        prompt.require_match(asked, skipping=resumed)
    elif (
        asked and isinstance(prompt, ConsoleOperator) and not (prompt.attended or prompt.elsewhere)
    ):
        times = "once" if len(asked) == 1 else f"{len(asked)} times"
        raise PreflightFailed(
            f"the run asks {times} for something to be done (first: {asked[0]!r}), and nobody "
            "could answer: it has no console",
            hint="start it in a terminal, or write the answers down: "
            f"hil {'resume RUN' if resumed else 'run SPEC'} --answers FILE; with --elsewhere it "
            "waits for hil answer",
        )


WIDEST = 90


class Console:
    """Lines typed at the terminal; written text goes to standard error.

    In the background (`hil run … &`) nothing is read: the system would suspend the whole process,
    and the robot with it.

    Args:
        read: Whether anything is read at all.
    """

    def __init__(self, *, read: bool = True) -> None:
        self._read = read
        self._typed = b""
        self._ended = False

    @property
    def present(self) -> bool:
        """Whether somebody may sit there."""
        return self._read and not self._ended and sys.stdin is not None and sys.stdin.isatty()

    def forget_typed(self) -> None:
        """What was typed before a question is no answer to it."""
        self._typed = b""
        if self.present and self._in_foreground():
            with contextlib.suppress(termios.error, OSError):
                termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)

    def line(self, wait_s: float) -> str | None:
        """The line typed within that time, without its end; None when there is none."""
        if not self.present or not self._in_foreground():
            time.sleep(wait_s)
            return None
        if not select.select([sys.stdin.fileno()], [], [], wait_s)[0]:
            return None
        new = os.read(sys.stdin.fileno(), 4096)
        self._ended = not new
        self._typed += new
        line, end, _ = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = b""
        return line.decode("utf-8", "replace").strip()

    def say(self, *paragraphs: str, ask: str = "") -> None:
        """Write paragraphs, and a question to be answered on the same line; rings the bell."""
        width = min(WIDEST, shutil.get_terminal_size().columns) - 1
        lines = [line for text in paragraphs for line in wrap(text, max(width, 20))]
        start = "\r\x1b[K\a" if sys.stderr.isatty() else "\n"
        sys.stderr.write(start + "".join(f"{line}\n" for line in lines) + ask)
        sys.stderr.flush()

    def show(self, lines: Iterable[str]) -> None:
        """Write lines; unprintable characters, such as terminal codes of a robot, are replaced."""
        start = "\r\x1b[K" if sys.stderr.isatty() else ""
        plain = ("".join(c if c.isprintable() else "?" for c in line) for line in lines)
        sys.stderr.write(start + "".join(f"{line}\n" for line in plain))
        sys.stderr.flush()

    @staticmethod
    def _in_foreground() -> bool:
        try:
            return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
        except OSError:  # not the terminal that controls this process: nobody is suspended
            return True


KEYS = ("prompt", "answer", "who")
WORDS = {"yes": True, "no": False, True: True, False: False}


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer.

    Attributes:
        prompt: Part of the text it answers, upper or lower case.
        yes: Whether it is done; a no stops the run.
        who: Recorded as who answered.
    """

    prompt: str
    yes: bool
    who: str

    def fits(self, text: str) -> bool:
        """Whether it answers this prompt."""
        return self.prompt.casefold() in text.casefold()


_HINT = "a list of {prompt: part of its text, answer: yes or no, who: name}, in order"


class ScriptedOperator:
    """The engine's `Prompt` that answers from a list, in order.

    Args:
        answers: In the order of the prompts.
        source: Where they stand, for messages.
    """

    def __init__(self, answers: Sequence[Answer], source: Source | None = None) -> None:
        self._answers = tuple(answers)
        self._source = source or Source("answers")
        self._next = 0
        self._skipping = False

    def __call__(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        """See `hil.engine.Prompt`; a prompt without its answer raises `SpecError`."""
        meanwhile()
        while self._skipping and self._misses(self._next, text):
            self._next += 1
        i, self._next = self._next, self._next + 1
        if problem := self._problem(i, text):
            raise SpecError(problem, hint=_HINT)
        return Reply(self._answers[i].yes, self._answers[i].who)

    def _misses(self, i: int, text: str) -> bool:
        return i < len(self._answers) and not self._answers[i].fits(text)

    def require_match(self, prompts: Sequence[str], *, skipping: bool = False) -> None:
        """Check the answers against everything a run is going to ask; a no ends both.

        Args:
            prompts: In order.
            skipping: Answers that fit nothing are left out: those of a run that is resumed.

        Raises:
            SpecError: A prompt has no answer, or an answer no prompt; with file, line and column.
        """
        self._skipping = skipping
        if skipping:
            self._require_some(prompts)
            return
        problems = [
            p for i, text in enumerate(self._asked(prompts)) if (p := self._problem(i, text))
        ]
        left = len(list(self._asked(prompts)))
        problems += [
            f"{self._source.mark((i,))}: the run has no prompt left for this answer"
            for i in range(left, len(self._answers))
        ]
        if problems:
            raise SpecError("\n".join(problems), hint=_HINT)

    def _require_some(self, prompts: Sequence[str]) -> None:
        i = 0
        for text in prompts:
            while self._misses(i, text):
                i += 1
            if i >= len(self._answers):
                raise SpecError(
                    f"{self._source.name}: no answer is there for the prompt '{shown(text)}'",
                    hint=_HINT,
                )
            i += 1

    def _asked(self, prompts: Sequence[str]) -> Iterator[str]:
        for i, text in enumerate(prompts):
            yield text
            if i < len(self._answers) and not self._answers[i].yes:
                return

    def _problem(self, i: int, text: str) -> str:
        if i >= len(self._answers):
            return f"{self._source.name}: no answer is left for the prompt '{shown(text)}'"
        if self._answers[i].fits(text):
            return ""
        return (
            f"{self._source.mark((i, 'prompt'))}: the run asks '{shown(text)}' here, "
            f"which does not contain '{shown(self._answers[i].prompt)}'"
        )


def load_answers(path: str | Path) -> ScriptedOperator:
    """Read answers from a YAML file.

    Raises:
        SpecError: With a line `file:line:column: place: message` for every problem.
    """
    source = read_source(path)
    if isinstance(source.data, list):
        answers = [_answer(source, i, entry) for i, entry in enumerate(source.data)]
    else:
        source.add((), "must be a list of answers")
    if source.problems:
        raise refuse(source.problems, hint=_HINT)
    return ScriptedOperator([answer for answer in answers if answer is not None], source)


def _answer(source: Source, i: int, entry: Any) -> Answer | None:
    if not isinstance(entry, dict):
        source.add((i,), "must be a mapping with prompt, answer and who")
        return None
    for key in entry.keys() - set(KEYS):
        source.add((i, key), f"unknown key; {did_you_mean(key, KEYS)}", key=True)
    for key in ("prompt", "answer"):
        if key not in entry:
            source.add((i,), f"{key} is missing")
    prompt, who = entry.get("prompt", "?"), entry.get("who", "script")
    for key, text in (("prompt", prompt), ("who", who)):
        if not (isinstance(text, str) and text.strip()):
            source.add((i, key), "must be text")
    word = entry.get("answer", "yes")
    if not isinstance(word, str | bool) or word not in WORDS:
        source.add((i, "answer"), f"must be yes or no, not {shown(word)}")
        return None
    return Answer(str(prompt), WORDS[word], str(who))


ANSWER_WITHIN_S = 300.0
"""The robot is held while its motion is confirmed, and what was shown is about the pose it stands
in: later answers do not count [s]."""

LOOK_EVERY_S = 0.05
TYPED = "typed"
JOINT_SLACK_RAD = math.radians(1.0)

BOX_SLACK_M = 0.01
"""What was confirmed covers a motion that goes so far beyond it: an arm drifts a little while it
stands."""

Document = dict[str, Any]


@dataclass(frozen=True)
class MotionFacts:
    """What a person has to know before a robot moves.

    Attributes:
        experiment: Name of the experiment; distinguishes the motions of a series.
        robot: Name in its station.
        model, driver: As the station says.
        address: Where its commands go.
        identity: Model, serial number and firmware of the controller; empty before connecting.
        loads: What is mounted, in the order of the plan.
        speed_share: Share of the speeds that the spec asks for; below 1 in commissioning runs.
        speed_rad_s: Largest speed of any joint [rad/s].
        speed_limit_rad_s: Largest joint speed that the robot allows [rad/s].
        swept: Duration, ranges of the joints, boxes of tool and elbow.
        checklist: What must be so before the robot moves.
        changed: What is not as it was confirmed before, each in a few words; shown only.
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


class Confirm(Protocol):
    """Who confirms that a real robot may move."""

    def admit(self, robot: str, address: str) -> None:
        """Raise `NotConfirmed` if this robot cannot be confirmed; asked before connecting."""

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """Return how and by whom the motion was confirmed.

        Args:
            facts: Of the motion that is about to begin.
            meanwhile: Called while waiting: it keeps reading the robot.

        Raises:
            NotConfirmed: It was not.
        """


@dataclass(frozen=True, slots=True)
class Unconfirmed:
    """The default: no real robot moves.

    Attributes:
        hint: How this caller confirms; by default as a call in Python does.
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
        typed = self._typed(meanwhile)
        if typed != facts.robot:
            said = f"{typed!r} was typed" if typed else "its name was not typed"
            raise NotConfirmed(
                f"{facts.robot} was not confirmed ({said}); nothing has moved",
                hint=f"run it again and type {facts.robot}",
            )
        return {"how": TYPED, "by": self.who or this_user()}

    def _show(self, facts: MotionFacts) -> None:
        must = [f"  [ ] {item}" for item in facts.checklist]
        about = ["", "A real robot is about to move:", *(f"  {line}" for line in facts.lines())]
        self.console.show([*about, *(["Its name also confirms that:", *must] if must else [])])

    def _typed(self, meanwhile: Callable[[], object]) -> str:
        deadline = time.monotonic() + ANSWER_WITHIN_S
        while self.console.present and time.monotonic() < deadline:
            if (line := self.console.line(LOOK_EVERY_S)) is not None:
                return line
            meanwhile()
        return ""


@dataclass(frozen=True, slots=True)
class Granted:
    """Confirmed beforehand, for what was named then and nothing else.

    Attributes:
        how: Recorded: `--yes`, `robot=`, `dashboard`, `armed`.
        who: Recorded; by default the user of this process.
        facts: What was confirmed, as `MotionFacts.to_dict` has it; keys that are left out may be
            anything. Of a series also `motions`, the facts of each experiment in order.
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
    """Return what is not as it was confirmed for this experiment of a series.

    The experiments before it may have left the arm anywhere they went, so that its own way there
    may sweep what they swept; payload and speed are its own.
    """
    different = [f"the experiment {now['experiment']} was not shown"]
    for i, one in enumerate(motions):
        if one["experiment"] == now["experiment"]:
            so_far = {"swept": _hull([each["swept"] for each in motions[: i + 1]])}
            if not (different := differences({**one, **so_far}, now)):
                break
    return different


def _hull(spaces: Sequence[Mapping[str, Any]]) -> Document:
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
    """Return a confirmation that was written to a file: `how`, `by` and `facts`.

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

    Only what both have is compared. A motion may sweep less than was confirmed and be slower;
    the identity and the checklist of the robot are not compared.

    Args:
        confirmed: As `MotionFacts.to_dict` has it, or part of it.
        now: The same of what is about to begin.
    """
    both = confirmed.keys() & now.keys()
    equal = [key for key in ("robot", "model", "driver", "address", "loads") if key in both]
    changes = [
        f"{key} was {_words(key, confirmed[key])}, is {_words(key, now[key])}"
        for key in equal
        if confirmed[key] != now[key]
    ]
    if "speed_rad_s" in both and now["speed_rad_s"] > confirmed["speed_rad_s"] * 1.01:
        was, is_ = (f"{math.degrees(one['speed_rad_s']):.3g}°/s" for one in (confirmed, now))
        changes.append(f"joint speed was {was}, is {is_}")
    if "swept" in both:
        changes += _beyond(confirmed["swept"], now["swept"])
    return changes


def _words(key: str, value: Any) -> str:
    if key != "loads":
        return str(value)
    return " then ".join(f"{one['mass_kg']:g} kg" for one in value or []) or "none"


def _beyond(confirmed: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
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


def together(motions: Sequence[Mapping[str, Any]]) -> Document:
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
    """Where a run asks whether its robot may move.

    Args:
        experiment: Says which robot of which station.
        confirm: Who confirms the motion of a real robot.
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
        """Return what has to be confirmed before a plan is executed; None where nothing has to be.

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
        """Return the record of the confirmation of a motion; None where none is needed.

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
            what = f"{refused.message}; not as confirmed before: {'; '.join(facts.changed)}"
            raise NotConfirmed(what, hint=refused.hint) from None
        return {**answer, "time": utc_now(), "facts": facts.to_dict(), "digest": facts.digest}

    def _holds(self, now: Mapping[str, Any]) -> bool:
        """Return whether the earlier confirmation has the same facts."""
        return all(self._confirmed.get(key) == value for key, value in now.items())


def _keep_reading(robot: Robot) -> None:
    """Read the robot, so that its driver neither fills up nor times out while a person reads."""
    robot.read()
    if isinstance(robot, HasTopics):
        robot.drain()


def shown_by(confirmation: Mapping[str, Any] | None) -> bool:
    """Return whether a person has just read the facts at the console."""
    return confirmation is not None and confirmation["how"] == TYPED


@dataclass(frozen=True, slots=True)
class Desk:
    """How a run reaches its operator.

    Attributes:
        prompt: Asks for a confirmation.
        go_on: Looks, without waiting, whether the operator ends a pause.
        wait_s: How long to wait for a robot that somebody else holds [s].
        confirm: Confirms that a real robot may move; by default it may not.
    """

    prompt: Prompt
    go_on: GoOn
    wait_s: float = 0.0
    confirm: Confirm = field(default_factory=Unconfirmed)


def console_desk(
    operator: str = "",
    *,
    answers: str | Path | None = None,
    wait_s: float = 0.0,
    elsewhere: bool = False,
    confirm: Confirm | None = None,
) -> Desk:
    """The console of this process, and other terminals.

    Args:
        operator: Who sits there; recorded with what they answer.
        answers: File with the answers to all prompts, in place of asking.
        wait_s: How long to wait for a robot that somebody else holds [s].
        elsewhere: Whether prompts wait for answers from other terminals only.
        confirm: Confirms that a real robot may move; by default the operator types its name here.

    Raises:
        SpecError: The file has mistakes; all are listed. Or answers come from both.
    """
    if elsewhere and answers is not None:
        raise SpecError("--answers and --elsewhere are two ways to answer", hint="choose one")
    console = Console(read=not elsewhere)
    sits = ConsoleOperator(operator or "operator", console, elsewhere=elsewhere)
    prompt: Prompt = sits if answers is None else load_answers(answers)
    return Desk(prompt, sits.goes_on, wait_s, confirm or TypedName(console, operator))
