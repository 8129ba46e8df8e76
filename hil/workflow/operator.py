"""Operator channels: answers to prompts, confirmation of motion, and end of pauses of a run.

`OperatorChannel` contains the prompt, the end of pauses and the confirmation of motion of one run;
`console_channel` creates the channel of a run that is started at a terminal. Prompts, such as a
request to mount a load, are answered at that terminal, at a different terminal or in the dashboard
(`ConsoleOperator`; remote answers arrive through `remote_control`). For CI and for robots that
change loads automatically, prompts are answered from a file written before the run
(`ScriptedOperator`)::

    - {prompt: Remove everything, answer: yes, who: gripper}
    - {prompt: 3 kg cylinder, answer: yes, who: gripper}

Each answer belongs to the next prompt; its key `prompt` is a part of the text of the prompt.
Prompts for a mock on a virtual clock are answered automatically (`prompt_on`). A run whose prompts
cannot be answered is refused before the robot moves (`require_attended`). The module
`motion_confirmation` handles the confirmation of motions.
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
    """Connection of a run to its operator: prompts, end of pauses, confirmation of motion.

    Attributes:
        prompt: Function that asks the operator to carry out an action and to confirm it.
        go_on: Function that returns, without waiting, whether the operator ends a pause.
        wait_s: Maximum time to wait for a robot that another process uses [s].
        confirm: Function that confirms that a real robot may move; by default every motion of a
            real robot is refused.
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
        operator: Name of the operator, recorded with the answers.
        answers: File with the answers to all prompts; with this file, the operator is not asked.
        wait_s: Maximum time to wait for a robot that another process uses [s].
        remote: Whether prompts are answered only from other terminals.
        confirm: Function that confirms that a real robot may move; by default the operator types
            the name of the robot at this console.

    Raises:
        SpecError: The file of answers has errors, which are all listed, or both `answers` and
            `remote` are passed.
    """
    if remote and answers is not None:
        raise SpecError("--answers and --no-console exclude each other", hint="choose one")
    console = Console(read=not remote)
    at_console = ConsoleOperator(operator or "operator", console, remote=remote)
    prompt: Prompt = at_console if answers is None else load_answers(answers)
    confirm = confirm or TypedName(console, operator)
    return OperatorChannel(prompt, at_console.pause_ended_by, wait_s, confirm)


NEW_PAUSE_AFTER_S = 3.0
"""Time without a read of the console after which the next read belongs to a new pause [s].

Lines that were typed before a new pause are discarded.
"""

WAIT_S = 0.05
YES, NO = ("y", "yes"), ("n", "no")


@runtime_checkable
class _Operator(Protocol):
    """Prompt function that can report before a run whether it can answer all prompts of the run.

    Attributes:
        replaces_mock: Whether the operator is asked even for a mock on a virtual clock.
    """

    @property
    def replaces_mock(self) -> bool: ...

    def require_answers(self, prompts: Sequence[str], *, resumed: bool) -> None: ...


class ConsoleOperator:
    """Prompt function of the engine for a run with an operator.

    Args:
        who: Name of the operator, recorded with the answers typed at the console.
        console: Console of this process, at which the operator answers.
        remote: Whether all answers come from other processes; the console is then not used, and
            prompts of a mock are not answered automatically.
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
        """Whether a console is available at which an operator can answer."""
        return self._console.present

    @property
    def replaces_mock(self) -> bool:
        """Whether the operator is asked even for a mock; True if all answers are remote."""
        return self.remote

    def require_answers(self, prompts: Sequence[str], *, resumed: bool) -> None:
        """Raise if the run has prompts that could not be answered.

        Raises:
            PreflightFailed: The run has prompts, but there is no console.
        """
        if not prompts or self.attended or self.remote:
            return
        many = "a prompt" if len(prompts) == 1 else f"{len(prompts)} prompts"
        raise PreflightFailed(
            f"the run has {many} (first: {prompts[0]!r}) but no console to answer "
            f"{'it' if len(prompts) == 1 else 'them'}",
            hint="start the run in a terminal, or pass a file of answers: "
            f"hil {'resume RUN' if resumed else 'run SPEC'} --answers FILE; with --no-console the "
            "run waits for hil answer",
        )

    def accept_remote_answers(self, run: Path | None) -> None:
        """Accept answers to the prompts of a run from other processes; None ends the acceptance."""
        with self._asking:
            self._run = run
            if run is not None:
                self._number = 0  # restart the numbering of prompts

    def answer(self, yes: bool, who: str, prompt: str, prompt_number: int = 0) -> str:
        """Record an answer from another thread; return a reason for refusal, else an empty string.

        Args:
            yes: Whether the requested action is done; False stops the run.
            who: Name of the user who answers, for the record.
            prompt: Text of the prompt to answer; the answer is refused if a different prompt is
                open.
            prompt_number: Number of the prompt within this run, needed because a later prompt may
                have the same text; 0 if only the text is known.
        """
        with self._asking:
            if not self._open_prompt:
                return "the run has no open prompt"
            if prompt != self._open_prompt:
                return f"the open prompt is now: {self._open_prompt!r}"
            if prompt_number not in (0, self._number):
                return f"prompt {prompt_number} is closed; prompt {self._number} is open"
            if yes and self._answer is not None:  # "no" always counts, because it stops the run
                return f"{self._answer.words} already"
            self._answer = Reply(yes, who)
            return ""

    def __call__(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        """Show a prompt and wait for the answer.

        Args:
            text: Action that the operator has to carry out and to confirm.
            meanwhile: Function that is called repeatedly while the operator decides; see
                `hil.engine.Prompt`.

        Returns:
            Answer and name of the user who answered; `NOBODY` if no operator can answer.
        """
        with self._asking:
            self._number += 1  # always, because the engine also counts this prompt
        if not (self.attended or self._run):
            return NOBODY
        with self._asking:
            self._open_prompt, self._answer = text, None
        try:
            meanwhile()  # writes the last progress line before the question
            self._console.forget_typed()
            self._ask(text)
            return self._wait(text, meanwhile)
        finally:
            with self._asking:
                self._open_prompt = ""

    def pause_ended_by(self) -> str:
        """Return the operator's name if Enter was pressed to end a pause, else an empty string.

        `pause_ended_by` returns at once, without waiting for input.
        """
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
            if not (self.attended or self._run):  # the terminal was closed
                return NOBODY
            before, pausing = pausing, meanwhile()
            if pausing and not before:
                self._console.say(f"pausing after the answer to this prompt: {pausing}")
                self._ask(text)
        self._console.say(f"{reply.words} (not at this terminal)")
        return reply

    @overload
    def _final_answer(self, typed: Reply) -> Reply: ...
    @overload
    def _final_answer(self, typed: None = None) -> Reply | None: ...

    def _final_answer(self, typed: Reply | None = None) -> Reply | None:
        """Return the valid answer and accept no later answer; None if there is no answer yet.

        A negative answer from another process stops the run, even if a positive answer is typed at
        the same moment.
        """
        with self._asking:
            replies = [reply for reply in (self._answer, typed) if reply is not None]
            if not replies:
                return None
            self._open_prompt = ""
            return next((reply for reply in replies if not reply.yes), replies[0])


@dataclass(frozen=True, slots=True)
class Answer:
    """Scripted answer to one prompt of a run.

    Attributes:
        prompt: Part of the text of the prompt, in upper or lower case.
        yes: Whether the requested action is done; False stops the run.
        who: Name that is recorded as the author of the answer.
    """

    prompt: str
    yes: bool
    who: str

    def fits(self, text: str) -> bool:
        """Return whether this answer belongs to a prompt with this text."""
        return self.prompt.casefold() in text.casefold()


class ScriptedOperator:
    """Prompt function of the engine that takes the answers from a list, in order.

    Args:
        answers: List of answers in the order of the prompts.
        source: Name of the source of the answers, used in error messages.
    """

    def __init__(self, answers: Sequence[Answer], source: Source | None = None) -> None:
        self._answers = tuple(answers)
        self._source = source or Source("answers")
        self._next = 0
        self._skipping = False

    def __call__(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        """Return the next answer of the list; see `hil.engine.Prompt`.

        Raises:
            SpecError: There is no answer for the prompt, or the next answer belongs to a different
                prompt.
        """
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
        """Whether the scripted answers are used even for a mock; always True."""
        return True

    def require_answers(self, prompts: Sequence[str], *, resumed: bool = False) -> None:
        """Raise if the list of answers does not match the prompts that a run will have.

        The comparison of answers and prompts ends at the first negative answer, because that answer
        stops the run.

        Args:
            prompts: Texts of all prompts of the run, in order.
            resumed: Whether answers without a prompt are skipped, because a resumed run has only
                some of the prompts.

        Raises:
            SpecError: A prompt has no answer, or an answer has no prompt; the message contains
                file, line and column.
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
    """Return the prompt function that takes its answers from a YAML file.

    Raises:
        SpecError: The file of answers has errors; the message has one line per error:
            `file:line:column: place: message`.
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
    """Return the prompt function for a run with this robot.

    Prompts for a mock on a virtual clock are answered automatically, unless the answers come from a
    file or another terminal (`--answers`, `--no-console`), which allows tests of these options.
    """
    replaces_mock = isinstance(prompt, _Operator) and prompt.replaces_mock
    return answer_as_mock if robot.capabilities.clock == "virtual" and not replaces_mock else prompt


def answer_as_mock(text: str, meanwhile: Callable[[], object]) -> Reply:
    """Answer the prompt of a run with a mock positively.

    A robot on a virtual clock mounts the declared load at once.
    """
    return Reply(yes=True, who="mock")


def prompts_of(plan: Plan) -> list[str]:
    """Return the texts of all prompts of a plan, in order."""
    prompts = (plan.loads[step.load].prompt for step in plan if step.kind == "payload")
    return [text for text in prompts if text]


def require_attended(plan: Plan, prompt: Prompt, *, resumed: bool = False) -> None:
    """Raise before any motion if a run has prompts that could not be answered.

    Args:
        plan: Plan that is about to be executed.
        prompt: Prompt function returned by `prompt_on`.
        resumed: Whether the run is resumed, so that some prompts may have been answered in an
            earlier attempt.

    Raises:
        PreflightFailed: The run has prompts, but there is no console.
        SpecError: The answers in the file do not match the prompts of the run.
    """
    if isinstance(prompt, _Operator):
        prompt.require_answers(prompts_of(plan), resumed=resumed)
