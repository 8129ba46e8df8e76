"""Where the operator sits: motions are confirmed, prompts answered and pauses ended there."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from hil.core import SpecError
from hil.engine import GoOn, Prompt
from hil.workflow.answers import load_answers
from hil.workflow.confirmation import Confirm, TypedName, Unconfirmed
from hil.workflow.console import Console
from hil.workflow.operator import ConsoleOperator


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
