"""'Did you mean …?': the closest of a handful of known words."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

CUTOFF = 0.6
"""Of `difflib`: `cvs` and `csv` reach 0.67, and so, alas, do `speed` and `spec`."""

LONGEST_WORD = 64
"""Longer words are no typing slips, and comparing them would take noticeable time."""


def closest(word: str, options: Iterable[str]) -> str | None:
    """The option most like `word`, ignoring case and `-` against `_`, or None."""
    if len(word) > LONGEST_WORD:
        return None
    by_folded = {_fold(option): option for option in options}
    matches = get_close_matches(_fold(word), by_folded, n=1, cutoff=CUTOFF)
    return by_folded[matches[0]] if matches else None


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """A clause for the end of a message: `did you mean 'x'?`, or what there is to choose from."""
    known = sorted(options)
    if match := closest(word, known):
        return f"did you mean {match!r}?"
    return f"there is {', '.join(known)}" if known else "there is none"


def _fold(word: str) -> str:
    return word.casefold().replace("-", "_")
