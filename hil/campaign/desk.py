"""Where the operator sits: prompts are answered and pauses ended there."""

from __future__ import annotations

from dataclasses import dataclass

from hil.campaign.operator import ask_operator
from hil.engine import Prompt
from hil.engine.pausing import GoOn, nobody_goes_on


@dataclass(frozen=True, slots=True)
class Desk:
    """How a run reaches its operator.

    Attributes:
        prompt: Asks for a confirmation.
        go_on: Looks, without waiting, whether the operator ends a pause.
    """

    prompt: Prompt = ask_operator
    go_on: GoOn = nobody_goes_on
