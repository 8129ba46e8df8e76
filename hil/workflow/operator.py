"""The operator of a run: answers its prompts, confirms its motion and ends its pauses.

`OperatorChannel` holds the prompt, the end of pauses and the confirmation of motion of one run;
`console_channel` makes the one of a run that is started at a terminal. Prompts, such as to mount a
load, are answered at that terminal, at another one or in the dashboard (`ConsoleOperator`; answers
from elsewhere arrive through `remote_control`), or by a file that was written before the run
(`ScriptedOperator`), for CI and for robots that load themselves::

    - {prompt: Remove everything, answer: yes, who: gripper}
    - {prompt: 3 kg cylinder, answer: yes, who: gripper}

in the order of the prompts; `prompt` is a part of the text. A mock on a virtual clock answers by
itself (`prompt_on`). A run with prompts that could not be answered is refused before anything moves
(`require_attended`). How motion is confirmed: `motion_confirmation`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, overload, runtime_checkable

from hil.core import PreflightFailed, Source, SpecError, did_you_mean, read_source, refuse, shown
from hil.engine import NOBODY, GoOn, Prompt, Reply
from hil.planning import Plan
from hil.robot import Robot
from hil.workflow.console import Console
from hil.workflow.motion_confirmation import Confirm, TypedName, Unconfirmed


@dataclass(frozen=True, slots=True)
class OperatorChannel:
    """How a run reaches its operator.

    Attributes:
        prompt: Asks for a confirmation.
        go_on: Returns, without waiting, whether the operator ends a pause.
        wait_s: How long to wait for a robot that another process holds [s].
        confirm: Confirms that a real robot may move; by default it may not.
    """

    prompt: Prompt
    go_on: GoOn
    wait_s: float = 0.0
    confirm: Confirm = field(default_factory=Unconfirmed)


def console_channel(
    operator: str = "",
    *,
    answers: str | Path | None = None,
    wait_s: float = 0.0,
    remote: bool = False,
    confirm: Confirm | None = None,
) -> OperatorChannel:
    """Return the operator channel of a run that is started at the console of this process.

    Args:
        operator: Name of the operator; recorded with the answers.
        answers: File with the answers to all prompts, in place of asking.
        wait_s: How long to wait for a robot that another process holds [s].
        remote: Whether prompts wait for answers from other terminals only.
        confirm: Confirms that a real robot may move; by default the operator types its name here.

    Raises:
        SpecError: The file has mistakes; all are listed. Or answers come from both.
    """
    if remote and answers is not None:
        raise SpecError("--answers and --elsewhere are two ways to answer", hint="choose one")
    console = Console(read=not remote)
    at_console = ConsoleOperator(operator or "operator", console, remote=remote)
    prompt: Prompt = at_console if answers is None else load_answers(answers)
    confirm = confirm or TypedName(console, operator)
    return OperatorChannel(prompt, at_console.pause_ended_by, wait_s, confirm)


NEW_PAUSE_AFTER_S = 3.0
"""If the console was not read for this long [s], a new pause has begun: lines typed before it are
discarded."""

WAIT_S = 0.05
YES, NO = ("y", "yes"), ("n", "no")


@runtime_checkable
class _Operator(Protocol):
    """A prompt that knows before the run whether it can answer.

    Attributes:
        replaces_mock: Whether it also answers for a mock on a virtual clock.
    """

    @property
    def replaces_mock(self) -> bool: ...

    def require_answers(self, prompts: Sequence[str], *, resumed: bool) -> None: ...


class ConsoleOperator:
    """The engine's `Prompt` for a run with an operator.

    Args:
        who: Recorded for answers at the console.
        console: Of this process.
        remote: Whether all answers come from elsewhere: the console is not used, and a mock is
            asked like any other robot.
    """

    def __init__(
        self,
        who: str = "operator",
        console: Console | None = None,
        *,
        remote: bool = False,
    ) -> None:
        self._who = who
        self._console = console or Console(read=not remote)
        self.remote = remote
        self._run: Path | None = None
        self._asking = threading.Lock()
        self._open_prompt, self._number = "", 0
        self._answer: Reply | None = None
        self._last_read = -NEW_PAUSE_AFTER_S

    @property
    def attended(self) -> bool:
        """Whether there is a console that an operator may sit at."""
        return self._console.present

    @property
    def replaces_mock(self) -> bool:
        """Whether it also answers for a mock: only if all answers come from elsewhere."""
        return self.remote

    def require_answers(self, prompts: Sequence[str], *, resumed: bool) -> None:
        """Raise if there are prompts that could not be answered.

        Raises:
            PreflightFailed: There is no console.
        """
        if not prompts or self.attended or self.remote:
            return
        many = "a prompt" if len(prompts) == 1 else f"{len(prompts)} prompts"
        raise PreflightFailed(
            f"the run has {many} (first: {prompts[0]!r}) but no console to answer "
            f"{'it' if len(prompts) == 1 else 'them'}",
            hint="start it in a terminal, or write the answers down: "
            f"hil {'resume RUN' if resumed else 'run SPEC'} --answers FILE; with --elsewhere it "
            "waits for hil answer",
        )

    def accept_remote_answers(self, run: Path | None) -> None:
        """Accept answers to this run's prompts from other processes; None stops accepting."""
        with self._asking:
            self._run = run
            if run is not None:
                self._number = 0  # of its prompts

    def answer(self, yes: bool, who: str, prompt: str, prompt_number: int = 0) -> str:
        """Record an answer from another thread; return why it was refused, else an empty string.

        Args:
            yes: Whether it is done; a no stops the run.
            who: Recorded.
            prompt: The text that is answered; an answer to another one is not taken.
            prompt_number: Number of the prompt in this run, as the next one may have the same text;
                0 if only the text is known.
        """
        with self._asking:
            if not self._open_prompt:
                return "the run has no open prompt"
            if prompt != self._open_prompt:
                return f"the open prompt is now: {self._open_prompt!r}"
            if prompt_number not in (0, self._number):
                return f"prompt {prompt_number} is closed; prompt {self._number} is open"
            if yes and self._answer is not None:  # a no counts in any case: it stops the run
                return f"{self._answer.words} already"
            self._answer = Reply(yes, who)
            return ""

    def __call__(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        """Ask and wait.

        Args:
            text: What is to be done and confirmed.
            meanwhile: Called while waiting; see `hil.engine.Prompt`.

        Returns:
            The answer and its author; `NOBODY` if it could not be answered.
        """
        with self._asking:
            self._number += 1  # in any case: the engine counts this prompt, too
        if not (self.attended or self._run):
            return NOBODY
        with self._asking:
            self._open_prompt, self._answer = text, None
        try:
            meanwhile()  # lets the last progress line be written before the question
            self._console.forget_typed()
            self._ask(text)
            return self._wait(text, meanwhile)
        finally:
            with self._asking:
                self._open_prompt = ""

    def pause_ended_by(self) -> str:
        """Return the operator's name if Enter was pressed to end a pause, else nothing; no wait."""
        now = time.monotonic()
        if now - self._last_read > NEW_PAUSE_AFTER_S:
            self._console.forget_typed()
        self._last_read = now
        pressed = self.attended and self._console.line(0.0) is not None
        return self._who if pressed else ""

    def _ask(self, text: str) -> None:
        remote = f"hil answer {self._run} yes" if self._run else ""
        if not self.attended:
            self._console.say(text, f"waiting for: {remote}")
        else:
            hint = [f"(or, from another terminal: {remote})"] if remote else []
            self._console.say(text, *hint, ask="Type yes when done, no to stop: ")

    def _wait(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        pausing: object = ""
        while (reply := self._final_answer()) is None:
            line = self._console.line(WAIT_S)
            if line is not None and line.lower() in YES + NO:
                typed = Reply(line.lower() in YES, self._who)
                return self._final_answer(typed)
            if line is not None:
                self._console.say(ask="Please type yes or no: ")
            if not (self.attended or self._run):  # the terminal has gone
                return NOBODY
            before, pausing = pausing, meanwhile()
            if pausing and not before:
                self._console.say(f"pausing once the question is answered: {pausing}")
                self._ask(text)
        self._console.say(f"{reply.words} (not at this terminal)")
        return reply

    @overload
    def _final_answer(self, typed: Reply) -> Reply: ...
    @overload
    def _final_answer(self, typed: None = None) -> Reply | None: ...

    def _final_answer(self, typed: Reply | None = None) -> Reply | None:
        """Return the answer that counts, and take no further one; None if there is none yet.

        A no that was taken from elsewhere stops the run, whatever is typed in that moment.
        """
        with self._asking:
            replies = [reply for reply in (self._answer, typed) if reply is not None]
            if not replies:
                return None
            self._open_prompt = ""
            return next((reply for reply in replies if not reply.yes), replies[0])


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer.

    Attributes:
        prompt: Part of the text of the prompt, in upper or lower case.
        yes: Whether it is done; a no stops the run.
        who: Recorded as the author of the answer.
    """

    prompt: str
    yes: bool
    who: str

    def fits(self, text: str) -> bool:
        """Return whether it answers this prompt."""
        return self.prompt.casefold() in text.casefold()


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
        """Answer; see `hil.engine.Prompt`. A prompt without its answer raises `SpecError`."""
        meanwhile()
        while self._skipping and self._is_unused(self._next, text):
            self._next += 1
        i, self._next = self._next, self._next + 1
        if problem := self._problem(i, text):
            raise SpecError(problem, hint=_FORMAT_HINT)
        return Reply(self._answers[i].yes, self._answers[i].who)

    def _is_unused(self, i: int, text: str) -> bool:
        return i < len(self._answers) and not self._answers[i].fits(text)

    @property
    def replaces_mock(self) -> bool:
        """Whether it also answers for a mock: always."""
        return True

    def require_answers(self, prompts: Sequence[str], *, resumed: bool = False) -> None:
        """Compare the answers with all prompts that a run will have; a no ends both.

        Args:
            prompts: In order.
            resumed: Whether answers that fit no prompt are left out: a resumed run has not all of
                the prompts.

        Raises:
            SpecError: A prompt has no answer, or an answer no prompt; with file, line and column.
        """
        self._skipping = resumed
        if resumed:
            self._require_some(prompts)
            return
        answered = list(self._prompts_until_no(prompts))
        problems = [p for i, text in enumerate(answered) if (p := self._problem(i, text))]
        left = len(answered)
        problems += [
            f"{self._source.mark((i,))}: the run has no prompt left for this answer"
            for i in range(left, len(self._answers))
        ]
        if problems:
            raise SpecError("\n".join(problems), hint=_FORMAT_HINT)

    def _require_some(self, prompts: Sequence[str]) -> None:
        i = 0
        for text in prompts:
            while self._is_unused(i, text):
                i += 1
            if i >= len(self._answers):
                raise SpecError(
                    f"{self._source.name}: no answer matches the prompt '{shown(text)}'",
                    hint=_FORMAT_HINT,
                )
            i += 1

    def _prompts_until_no(self, prompts: Sequence[str]) -> Iterator[str]:
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
    """Return the operator that answers from a YAML file.

    Raises:
        SpecError: With a line `file:line:column: place: message` for every problem.
    """
    source = read_source(path)
    if isinstance(source.data, list):
        answers = [_answer_of(source, i, entry) for i, entry in enumerate(source.data)]
    else:
        source.add((), "must be a list of answers")
    if source.problems:
        raise refuse(source.problems, hint=_FORMAT_HINT)
    return ScriptedOperator([answer for answer in answers if answer is not None], source)


ANSWER_KEYS = ("prompt", "answer", "who")
ANSWER_WORDS = {"yes": True, "no": False, True: True, False: False}


def _answer_of(source: Source, i: int, entry: Any) -> Answer | None:
    if not isinstance(entry, dict):
        source.add((i,), "must be a mapping with prompt, answer and who")
        return None
    for key in entry.keys() - set(ANSWER_KEYS):
        source.add((i, key), f"unknown key; {did_you_mean(key, ANSWER_KEYS)}", key=True)
    for key in ("prompt", "answer"):
        if key not in entry:
            source.add((i,), f"{key} is missing")
    prompt, who = entry.get("prompt", "?"), entry.get("who", "script")
    for key, text in (("prompt", prompt), ("who", who)):
        if not (isinstance(text, str) and text.strip()):
            source.add((i, key), "must be text")
    word = entry.get("answer", "yes")
    if not isinstance(word, str | bool) or word not in ANSWER_WORDS:
        source.add((i, "answer"), f"must be yes or no, not {shown(word)}")
        return None
    return Answer(str(prompt), ANSWER_WORDS[word], str(who))


_FORMAT_HINT = "a list of {prompt: part of its text, answer: yes or no, who: name}, in order"


def prompt_on(robot: Robot, prompt: Prompt) -> Prompt:
    """Return the prompt for this robot.

    Mocks on a virtual clock answer themselves, unless answers come from a file or another terminal
    (`--answers`, `--elsewhere`), which is for testing these.
    """
    replaces_mock = isinstance(prompt, _Operator) and prompt.replaces_mock
    return answer_as_mock if robot.capabilities.clock == "virtual" and not replaces_mock else prompt


def answer_as_mock(text: str, meanwhile: Callable[[], object]) -> Reply:
    """Answer for a mock: a robot on a virtual clock mounts the declared load at once."""
    return Reply(yes=True, who="mock")


def prompts_of(plan: Plan) -> list[str]:
    """Return all prompts of a plan, in order."""
    prompts = (plan.loads[step.load].prompt for step in plan if step.kind == "payload")
    return [text for text in prompts if text]


def require_attended(plan: Plan, prompt: Prompt, *, resumed: bool = False) -> None:
    """Raise, before anything moves, if a run has prompts that could not be answered.

    Args:
        plan: What is about to be executed.
        prompt: What answers, from `prompt_on`.
        resumed: Whether some of the prompts may have been answered in an earlier attempt.

    Raises:
        PreflightFailed: It has prompts, and there is no console.
        SpecError: The answers of a file are not those to its prompts.
    """
    if isinstance(prompt, _Operator):
        prompt.require_answers(prompts_of(plan), resumed=resumed)
