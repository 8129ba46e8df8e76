"""Asking the operator: at the console, from elsewhere, from a file, or not at all."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil.arms.payload import Payload
from hil.core.errors import PreflightFailed, SpecError, Stopped
from hil.engine import NOBODY, Reply
from hil.planning.plan import LoadStep, Step
from hil.robot import Capabilities
from hil.workflow.console import Console
from hil.workflow.operator import (
    ConsoleOperator,
    ScriptedOperator,
    answer_as_mock,
    console_channel,
    load_answers,
    prompt_on,
    prompts_of,
    require_attended,
)
from tests.support.engine_parts import small_plan
from tests.support.kinematic_robot import KinematicRobot
from tests.support.waiting import until

MOUNT = "Mount the 3 kg disc"


class FakeConsole(Console):
    """Types the given lines, one a look."""

    def __init__(self, *typed: str | None, there: bool = True) -> None:
        super().__init__()
        self.typed = list(typed)
        self.there = there
        self.told: list[str] = []

    @property
    def present(self) -> bool:
        return self.there

    def forget_typed(self) -> None:
        self.told.append("forgot")

    def line(self, wait_s: float) -> str | None:
        if not self.typed:
            time.sleep(min(wait_s, 0.01))
        return self.typed.pop(0) if self.typed else None

    def say(self, *paragraphs: str, ask: str = "") -> None:
        self.told.append("\n".join([*paragraphs, ask]))


def operator(*typed: str | None, there: bool = True) -> tuple[ConsoleOperator, FakeConsole]:
    console = FakeConsole(*typed, there=there)
    return ConsoleOperator("anna", console), console


@pytest.mark.parametrize(
    ("typed", "yes"), [("yes", True), ("Y", True), ("no", False), ("N", False)]
)
def test_yes_confirms_and_no_refuses_and_both_have_a_name(typed: str, yes: bool) -> None:
    asks, console = operator(None, typed)
    assert asks(MOUNT, lambda: None) == Reply(yes, "anna")
    assert console.told[0] == "forgot"  # what was typed before the question is no answer to it
    assert MOUNT in console.told[1]


def test_what_is_shown_steers_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    Console().show(["serial number 7\x1b[2J\r", "wrist_1_joint  -80° to 12°"])
    assert capsys.readouterr().err == "serial number 7?[2J?\nwrist_1_joint  -80° to 12°\n"


def test_a_slip_of_the_fingers_is_asked_again() -> None:
    asks, console = operator("", "yess", "yes")
    assert asks(MOUNT, lambda: None) == Reply(True, "anna")
    assert console.told[2:] == ["Please type yes or no: "] * 2


def test_a_stop_ends_the_question() -> None:
    asks, _ = operator()

    def stopped() -> None:
        raise Stopped("smoke")

    with pytest.raises(Stopped):
        asks(MOUNT, stopped)
    assert asks.answer(True, "bert", MOUNT) == "the run has no open prompt"


def test_without_a_console_nobody_answers_unless_others_can(tmp_path: Path) -> None:
    asks, _ = operator(there=False)
    assert asks(MOUNT, lambda: None) == NOBODY
    asks.accept_remote_answers(tmp_path)
    assert answered_by_bert(asks, yes=True) == Reply(True, "bert")


def answered_by_bert(asks: ConsoleOperator, *, yes: bool) -> Reply:
    got: list[Reply] = []
    asking = threading.Thread(target=lambda: got.append(asks(MOUNT, lambda: None)))
    asking.start()
    until(lambda: asks.answer(yes, "bert", MOUNT) == "")
    asking.join(5)
    return got[0]


@pytest.mark.parametrize("yes", [True, False])
def test_others_may_answer_while_the_console_waits(yes: bool, tmp_path: Path) -> None:
    asks, console = operator()
    asks.accept_remote_answers(tmp_path)
    assert answered_by_bert(asks, yes=yes) == Reply(yes, "bert")
    assert f"hil answer {tmp_path} yes" in console.told[1]
    assert console.told[-1].startswith("bert answered")


def test_an_answer_to_another_question_is_not_taken(tmp_path: Path) -> None:
    asks, _ = operator()
    asks.accept_remote_answers(tmp_path)
    refusals: list[str] = []

    def meanwhile() -> None:
        refusals.append(asks.answer(True, "bert", "Remove everything"))
        if len(refusals) == 3:
            asks.answer(False, "bert", MOUNT)

    assert asks(MOUNT, meanwhile) == Reply(False, "bert")
    assert refusals[0] == f"the open prompt is now: {MOUNT!r}"


def test_an_answer_to_an_earlier_prompt_of_the_same_text_is_not_taken(tmp_path: Path) -> None:
    asks, _ = operator()
    asks.accept_remote_answers(tmp_path)
    refusals: list[str] = []

    def twice_yes() -> None:
        """As a double click would; then the next one by its own number."""
        refusals.append(asks.answer(True, "bert", MOUNT, 1))
        if len(refusals) == 3:
            asks.answer(True, "bert", MOUNT, 2)

    assert asks(MOUNT, twice_yes).yes
    assert asks(MOUNT, twice_yes).yes
    over = "prompt 1 is closed; prompt 2 is open"
    assert refusals[0] == ""
    assert over in refusals[1:]
    assert len(refusals) >= 3


def test_another_run_counts_its_prompts_anew(tmp_path: Path) -> None:
    asks, _ = operator()
    for run in (tmp_path / "0001", tmp_path / "0002"):
        asks.accept_remote_answers(run)
        said: list[str] = []

        def meanwhile(said: list[str] = said) -> None:
            said.append(asks.answer(True, "bert", MOUNT, 1))
            asks.answer(True, "bert", MOUNT)  # or it would wait for ever

        assert asks(MOUNT, meanwhile).yes
        assert said[0] == ""


def test_a_no_counts_after_a_yes_and_a_yes_not_after_a_no(tmp_path: Path) -> None:
    asks, _ = operator()
    asks.accept_remote_answers(tmp_path)

    def all_at_once() -> None:
        said = [asks.answer(yes, "bert", MOUNT, 1) for yes in (True, False, True)]
        assert said == ["", "", "bert answered no already"]

    assert asks(MOUNT, all_at_once) == Reply(False, "bert")


class LateConsole(FakeConsole):
    """Types yes just after somebody elsewhere has answered."""

    def __init__(self, answered: Callable[[], str]) -> None:
        super().__init__()
        self.answered, self.said = answered, list[str]()

    def line(self, wait_s: float) -> str | None:
        self.said.append(self.answered())
        return "yes"


@pytest.mark.parametrize("yes", [True, False])
def test_a_no_that_was_taken_counts_whatever_is_typed_in_that_moment(
    yes: bool, tmp_path: Path
) -> None:
    console = LateConsole(lambda: asks.answer(yes, "bert", MOUNT, 1))
    asks = ConsoleOperator("anna", console)
    asks.accept_remote_answers(tmp_path)
    assert asks(MOUNT, lambda: None) == Reply(yes, "bert")
    assert console.said == [""]
    assert asks.answer(False, "bert", MOUNT, 1) == "the run has no open prompt"


def test_a_pause_asked_for_meanwhile_waits_and_the_question_is_repeated() -> None:
    asks, console = operator(None, None, None, "yes")
    wishes = iter(["", "SIGINT: Enter goes on", "SIGINT: Enter goes on", ""])
    assert asks(MOUNT, lambda: next(wishes)).yes
    said = "pausing after the answer to this prompt: SIGINT: Enter goes on\n"
    assert console.told[2:] == [said, console.told[1]]


def test_enter_ends_a_pause_but_not_one_pressed_before_it() -> None:
    asks, console = operator(None, None, "")
    assert [asks.pause_ended_by() for _ in range(3)] == ["", "", "anna"]
    assert console.told == ["forgot"]


def test_a_pause_of_a_run_without_console_is_not_ended_by_it() -> None:
    asks, _ = operator("", there=False)
    assert asks.pause_ended_by() == ""


# --- written answers -----------------------------------------------------------------------------


def answers(tmp_path: Path, text: str) -> ScriptedOperator:
    path = tmp_path / "answers.yaml"
    path.write_text(text, "utf-8")
    return load_answers(path)


GOOD = """\
- {prompt: remove EVERYTHING, answer: yes, who: gripper}
- prompt: 3 kg
  answer: yes
"""
ASKED = ("Remove everything from the flange", "Mount the 3 kg disc")


def test_written_answers_are_given_in_order(tmp_path: Path) -> None:
    scripted = answers(tmp_path, GOOD)
    scripted.require_answers(ASKED)
    reads: list[int] = []
    assert [scripted(text, lambda: reads.append(1)) for text in ASKED] == [
        Reply(True, "gripper"),
        Reply(True, "script"),
    ]
    assert len(reads) == 2


def test_a_written_no_refuses_and_ends_the_asking(tmp_path: Path) -> None:
    scripted = answers(tmp_path, "[{prompt: Remove, answer: no, who: ci}]")
    scripted.require_answers(ASKED)
    assert scripted(ASKED[0], lambda: None) == Reply(False, "ci")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[{prompt: 3 kg, answer: yes}]",
         [r"answers.yaml:1:11: the run asks 'Remove everything .*' here, which does not contain "
          "'3 kg'", r"no answer is left for the prompt 'Mount the 3 kg disc'"]),
        (GOOD + "- {prompt: more, answer: yes}\n",
         [r"answers.yaml:4:3: the run has no prompt left for this answer"]),
        ("[]", ["no answer is left for the prompt 'Remove everything", "for the prompt 'Mount"]),
        ("[{prompt: Remove, answer: no}, {prompt: 3 kg, answer: yes}]",
         ["answers.yaml:1:32: the run has no prompt left"]),
    ],
)  # fmt: skip
def test_answers_that_do_not_fit_are_refused_before_the_run(
    text: str, told: list[str], tmp_path: Path
) -> None:
    with pytest.raises(SpecError) as caught:
        answers(tmp_path, text).require_answers(ASKED)
    for line, wanted in zip(caught.value.message.splitlines(), told, strict=True):
        assert re.search(wanted, line)


def test_a_prompt_nobody_foresaw_ends_the_run(tmp_path: Path) -> None:
    scripted = answers(tmp_path, "[]")
    with pytest.raises(SpecError, match="no answer is left for the prompt 'Fetch coffee'"):
        scripted("Fetch coffee", lambda: None)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("prompt: x", "answers.yaml:1:1: must be a list of answers"),
        ("- yes", "answers.yaml:1:3: 0: must be a mapping"),
        ("- {prompt: x}", "answers.yaml:1:3: 0: answer is missing"),
        ("- {answer: yes}", "answers.yaml:1:3: 0: prompt is missing"),
        ("- {prompt: x, answer: perhaps}", "0.answer: must be yes or no, not perhaps"),
        ("- {prompt: x, answer: [yes]}", "0.answer: must be yes or no"),
        ("- {prompt: x, answer: 1}", "0.answer: must be yes or no, not 1"),
        ("- {prompt: 3, answer: yes}", "answers.yaml:1:12: 0.prompt: must be text"),
        ("- {prompt: '', answer: yes}", "0.prompt: must be text"),
        ("- {prompt: x, answer: yes, whom: me}", "0.whom: unknown key; did you mean 'who'"),
        ("- {prompt: x, answer: yes, answer: no}", "occurs twice"),
        ("- !!python/object:os.system {}", "the tag"),
        ("- {", "answers.yaml:1:"),
    ],
)
def test_mistakes_in_answers_are_told_with_their_place(
    text: str, told: str, tmp_path: Path
) -> None:
    with pytest.raises(SpecError) as caught:
        answers(tmp_path, text)
    assert told in caught.value.message


# --- before anything moves -----------------------------------------------------------------------


class RealRobot(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(("j1",), 125.0, "current", clock="wall")


def test_every_prompt_of_a_plan_is_foreseen() -> None:
    plan = small_plan(MOUNT)
    again = replace(plan.steps[-1], index=5)
    steps = (*plan.steps, Step(5, "payload", load=1), Step(6, "payload", load=2), again)
    loads = (*plan.loads, LoadStep(Payload(2.0), ""), LoadStep(Payload(3.0), "Then this"))
    assert prompts_of(replace(plan, steps=steps, loads=loads)) == [MOUNT, "Then this"]
    assert prompts_of(small_plan()) == []


def test_a_run_that_asks_and_has_nobody_to_answer_is_refused() -> None:
    nobody, _ = operator(there=False)
    with pytest.raises(PreflightFailed, match=r"has a prompt .* no console to answer it") as caught:
        require_attended(small_plan(MOUNT), nobody)
    assert "--answers FILE" in caught.value.hint
    require_attended(small_plan(), nobody)


def test_a_run_that_asks_is_let_through_with_a_console_answers_or_a_mock(tmp_path: Path) -> None:
    attended, _ = operator()
    require_attended(small_plan(MOUNT), attended)
    require_attended(small_plan(MOUNT), answer_as_mock)
    scripted = answers(tmp_path, "[{prompt: disc, answer: yes}]")
    require_attended(small_plan(MOUNT), scripted)
    with pytest.raises(SpecError, match="no prompt left"):
        require_attended(small_plan(), scripted)


def test_a_mock_answers_itself_unless_answers_are_written(tmp_path: Path) -> None:
    console, _ = operator()
    scripted = answers(tmp_path, "[]")
    assert prompt_on(KinematicRobot(), console) is answer_as_mock
    assert prompt_on(KinematicRobot(), scripted) is scripted
    assert prompt_on(RealRobot(), console) is console


def test_who_answers_from_elsewhere_is_waited_for_by_a_mock_too(tmp_path: Path) -> None:
    desk = console_channel("anna", remote=True)
    asks = desk.prompt
    assert isinstance(asks, ConsoleOperator)
    assert prompt_on(KinematicRobot(), asks) is asks
    require_attended(small_plan(MOUNT), asks)
    assert not asks.attended  # nothing is read from a terminal, should there be one
    asks.accept_remote_answers(tmp_path)
    looked = []

    def answered_at_the_third_look() -> None:
        looked.append(1)
        if len(looked) == 3:
            assert asks.answer(True, "bert", MOUNT) == ""

    assert asks(MOUNT, answered_at_the_third_look) == Reply(True, "bert")
    with pytest.raises(SpecError, match="exclude each other"):
        console_channel(answers=tmp_path / "answers.yaml", remote=True)


# --- a real terminal -----------------------------------------------------------------------------

ASKING = """
import sys, time
from hil.workflow.operator import ConsoleOperator
time.sleep(0.3)
who = ConsoleOperator()("Mount the 3 kg disc, with the label towards the base of the robot",
                        lambda: time.sleep(0.01))
sys.stderr.write(f"[{who.words}]")
"""


def read_until(terminal: int, done: Callable[[str], Any], seconds: float = 15.0) -> str:
    told, deadline = "", time.monotonic() + seconds
    while not done(told):
        assert time.monotonic() < deadline, told
        if select.select([terminal], [], [], 0.05)[0]:
            told += os.read(terminal, 4096).decode()
    return told


@pytest.mark.wire
def test_on_a_narrow_terminal_the_question_is_wrapped_and_early_typing_is_no_answer() -> None:
    pid, terminal = pty.fork()
    if pid == 0:  # pragma: no cover - becomes another program
        os.environ["COLUMNS"] = "40"
        os.execv(sys.executable, [sys.executable, "-c", ASKING])
    os.write(terminal, b"yes\n")
    told = read_until(terminal, lambda told: told.endswith("to stop: "))
    assert "\a" in told
    assert max(len(line) for line in told.splitlines()) <= 40
    time.sleep(0.2)  # an answer given before the question would have been taken by now
    os.write(terminal, b"no\n")
    assert "[operator answered no]" in read_until(terminal, lambda told: "]" in told)
    os.waitpid(pid, 0)
    os.close(terminal)


BACKGROUND = """
import os, signal, subprocess, sys
child = subprocess.Popen([sys.executable, "-c", '''
import os, sys, time
os.setpgid(0, 0)
from hil.workflow.operator import Console
console, began = Console(), time.monotonic()
console.forget_typed()
while time.monotonic() - began < 0.5:
    assert console.line(0.05) is None
''', ])
pid, status = os.waitpid(child.pid, os.WUNTRACED)
child.returncode = status
sys.stderr.write(f"<{os.WIFSTOPPED(status)} {os.WEXITSTATUS(status)}>")
"""


@pytest.mark.wire
def test_a_run_in_the_background_is_not_suspended_by_its_own_question() -> None:
    pid, terminal = pty.fork()
    if pid == 0:  # pragma: no cover - becomes another program
        os.execv(sys.executable, [sys.executable, "-c", BACKGROUND])
    time.sleep(0.2)
    os.write(terminal, b"yes\n")
    assert "<False 0>" in read_until(terminal, lambda told: ">" in told)
    os.waitpid(pid, 0)
    os.close(terminal)


def test_a_console_that_has_gone_is_no_console() -> None:
    code = "from hil.workflow.operator import Console; assert not Console().present"
    done = subprocess.run([sys.executable, "-c", code], stdin=subprocess.DEVNULL)
    assert done.returncode == 0
