"""Asking the operator: what a run asks with, and what comes back."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Reply(NamedTuple):
    """What came of a question.

    Attributes:
        yes: Whether it is done; a no stops the run.
        who: Who answered; empty when nobody did, which is no yes either.
    """

    yes: bool
    who: str

    @property
    def word(self) -> str:
        """`yes` or `no`; nothing when nobody answered."""
        return ("yes" if self.yes else "no") if self.who else ""

    @property
    def words(self) -> str:
        """`anna answered no`, for people."""
        return f"{self.who} answered {self.word}" if self.who else "nobody answered"


NOBODY = Reply(yes=False, who="")
"""Nobody could answer."""

Prompt = Callable[[str, Callable[[], object]], Reply]
"""Asks the operator; returns who answered what.

While it waits it calls its second argument again and again: that keeps reading the robot, raises
`Stopped` when somebody wants to stop, and returns why the run will pause once the question is
answered, nothing while it will not.
"""


def nobody(text: str, meanwhile: Callable[[], object]) -> Reply:
    """The prompt of an unattended run: nobody confirms."""
    return NOBODY
