"""Asking the person at the robot, who may also answer from another terminal."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from hil.core import PreflightFailed
from hil.engine import NOBODY, Prompt, Reply
from hil.planning import Plan
from hil.robot import Robot
from hil.workflow.answers import ScriptedOperator
from hil.workflow.console import Console

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
