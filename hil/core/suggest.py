"""'Did you mean …?': the known word, or the file, that a slip of typing made another of.

`closest` judges words: it believes few slips, and none that makes the opposite or another number,
as a wrong suggestion costs more than none. `neighbour_of` looks in the folder where a file was
looked for, and falls back on naming the folder that is missing or the few files of its kind.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from difflib import SequenceMatcher
from itertools import takewhile
from pathlib import Path

from hil.core.text import shown

LETTERS_A_SLIP = 4
"""A slip is believed for so many letters: one in `csv`, none that makes `spec` of `speed`."""

MOST_SLIPS = 3

LEAST_SHARE = 0.5
"""Of a name's letters: `velocity` is meant to be `max_velocity_deg_s`, `s` is not."""

STEM = 2 / 3
"""Of the longer word's letters, where both begin so: `validation` is meant to be `validate`."""

OPPOSITES = {
    frozenset(pair.split())
    for pair in (
        "min max", "on off", "on no", "enable disable", "enabled disabled", "lower upper",
        "above below", "before after", "start stop", "open close", "left right", "true false",
    )
}  # fmt: skip

NOT = ("un", "non", "no", "dis")
"""What makes the opposite of a word, before it or as a word of its own."""

LONGEST_WORD = 64
"""Longer words are no typing slips, and comparing them would take noticeable time."""


def closest(word: str, options: Iterable[str]) -> str | None:
    """The option that `word` is a slip of, or a part of, else None.

    Ignored are case and `-` against `_`. A slip is a letter too many, missing or another, or two
    neighbours swapped. Whoever gives whole words of an option means that one. Another number and
    the opposite are no slips: `ur5-003` is another arm than `ur5-001`.
    """
    if not 0 < len(word) <= LONGEST_WORD:
        return None
    typed = _fold(word)
    found: list[tuple[int, float, str]] = []
    for option in options:
        known = _fold(option)
        rank = _rank(typed, known)
        if rank is not None:
            unlike = 1 - SequenceMatcher(None, typed, known).ratio()
            found.append((rank, unlike, option))
    return min(found)[2] if found else None


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """A clause for the end of a message: `did you mean 'x'?`, or what there is to choose from."""
    known = sorted(options)
    if match := closest(word, known):
        return f"did you mean {match!r}?"
    return f"there is {', '.join(known)}" if known else "there is none"


def _fold(word: str) -> str:
    return word.casefold().replace("-", "_")


def _rank(typed: str, known: str) -> int | None:
    """How far an option is from what was typed, 0 being the same; None where it is another."""
    if typed == known:
        return 0
    if _is_opposite(typed, known) or _has_another_number(typed, known):
        return None
    part, slips = _is_part(typed, known), _slips(typed, known)
    if part and set(_words(typed)) <= set(_words(known)):
        return 1
    if slips is not None:
        return 1 + slips
    return MOST_SLIPS + 2 if part or _has_stem(typed, known) else None


def _is_opposite(typed: str, known: str) -> bool:
    one, other = set(_words(typed)), set(_words(known))
    apart = [(a, b) for a in one - other for b in other - one]
    return bool((one ^ other) & set(NOT)) or any(
        {a, b} in OPPOSITES or any(a == no + b or b == no + a for no in NOT) for a, b in apart
    )


def _words(text: str) -> list[str]:
    return re.findall(r"[^\W_]+", text)


_NUMBER = re.compile(r"[0-9]+")


def _has_another_number(typed: str, known: str) -> bool:
    return _NUMBER.sub("#", typed) == _NUMBER.sub("#", known) and _numbers_differ(typed, known)


def _numbers_differ(typed: str, known: str) -> bool:
    """Whether both have as many numbers, and others."""
    one, other = ([n.lstrip("0") for n in _NUMBER.findall(text)] for text in (typed, known))
    return len(one) == len(other) and one != other


def _is_part(typed: str, known: str) -> bool:
    """Whether one has all of the other, its words in any order, and not much more."""
    few, many = sorted((_words(typed), _words(known)), key=lambda words: len("".join(words)))
    letters, of = "".join(few), "".join(many)
    if len(letters) < 2 or len(letters) < LEAST_SHARE * len(of):
        return False
    return letters in of or all(any(_is_word(word, other) for other in many) for word in few)


def _is_word(word: str, other: str) -> bool:
    """Within a name, where short words have other neighbours to be told by, these must be right."""
    return word == other or (len(word) > LETTERS_A_SLIP and _slips(word, other) is not None)


def _slips(typed: str, known: str) -> int | None:
    """How many slips apart two words are, None where that is too many for their length."""
    if _numbers_differ(typed, known):
        return None
    length = max(len(typed), len(known))
    most = min(max(length // LETTERS_A_SLIP, 1), MOST_SLIPS)
    if typed != known and (min(len(typed), len(known)) < 2 or abs(len(typed) - len(known)) > most):
        return None
    count = _distance(typed, known)
    return count if count <= most else None


def _distance(a: str, b: str) -> int:
    """Edits between two words, a swap of neighbours being one (optimal string alignment)."""
    before: list[int] = []
    last = list(range(len(b) + 1))
    for i, x in enumerate(a, start=1):
        row = [i]
        for j, y in enumerate(b, start=1):
            least = min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (x != y))
            if i > 1 and j > 1 and x == b[j - 2] and y == a[i - 2]:
                least = min(least, before[j - 2] + 1)
            row.append(least)
        before, last = last, row
    return last[-1]


def _has_stem(typed: str, known: str) -> bool:
    alike = (x == y for x, y in zip(typed, known, strict=False))
    common = sum(1 for _ in takewhile(bool, alike))
    return common >= LETTERS_A_SLIP and common >= STEM * max(len(typed), len(known))


MOST_NAMED = 8
"""Files of a folder that a hint names."""

NOTHING_NEAR = "is the path right, seen from this folder?"
_MOST_LETTERS = 300


def neighbour_of(
    file: Path, endings: Iterable[str], fits: Callable[[Path], bool] = lambda _: True
) -> str:
    """What is there instead, as a hint: the folder missing, a near name, or the few of its kind.

    Args:
        file: What is not there.
        endings: Of what could be meant, such as `.urdf`.
        fits: Tells further whether something could be meant; `OSError` where nobody can know.
    """
    folder = file.parent
    wanted = tuple(endings)
    try:
        if not folder.is_dir():
            return f"there is no folder {shown(str(folder), _MOST_LETTERS)}"
        beside = [path for path in folder.iterdir() if path.suffix.casefold() in wanted]
        names = sorted(path.name for path in beside if fits(path))
    except (OSError, ValueError):  # ValueError: a name that no file system takes
        names = []
    if match := closest(file.name, names):
        return f"did you mean {folder / match}?"
    if 0 < len(names) <= MOST_NAMED:
        return f"there is {', '.join(names)}"
    return NOTHING_NEAR


def no_file(file: Path) -> str:
    """`there is no file poses.csv in /cell`: by its whole path, or with the folder it starts at."""
    told = f"there is no file {shown(str(file), _MOST_LETTERS)}"
    return told if file.is_absolute() else f"{told} in {shown(str(Path.cwd()), _MOST_LETTERS)}"


def no_file_but(file: Path, endings: Iterable[str]) -> str:
    """`no_file` with what is there instead, where that can be told, for a list of problems."""
    instead = neighbour_of(file, endings)
    return no_file(file) if instead == NOTHING_NEAR else f"{no_file(file)}; {instead}"
