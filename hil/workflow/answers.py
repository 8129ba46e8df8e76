"""Answers to prompts, written down before the run: for CI, and for robots that load themselves.

::

    - {prompt: Remove everything, answer: yes, who: gripper}
    - {prompt: 3 kg cylinder, answer: yes, who: gripper}

In the order in which the run asks; `prompt` is a part of what it says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import Source, SpecError, did_you_mean, read_source, refuse, shown
from hil.engine import Reply

KEYS = ("prompt", "answer", "who")
WORDS = {"yes": True, "no": False, True: True, False: False}
_HINT = "a list of {prompt: part of its text, answer: yes or no, who: name}, in order"


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
