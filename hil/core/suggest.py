"""Suggestions for mistyped names ('Did you mean …?'): the word or file that was probably intended.

`closest` compares words. The function `closest` accepts only few typing errors, and no change to an
opposite or to a different number, because a wrong suggestion is worse than none. The function
`neighbour_of` searches the folder of a missing file for similar names; without a similar name, it
names the missing folder, or the few files of the same kind.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from difflib import SequenceMatcher
from itertools import takewhile
from pathlib import Path

from hil.core.text import shown

LETTERS_A_SLIP = 4
"""Number of letters per accepted typing error: one error is accepted in `csv`, but `spec` does
not suggest `speed`."""

MOST_SLIPS = 3

LEAST_SHARE = 0.5
"""Minimum share of the letters of a name: `velocity` suggests `max_velocity_deg_s`, `s` does
not."""

STEM = 2 / 3
"""Minimum length of the common beginning of two words, as a share of the longer word.

For example, the word `validation` suggests `validate`.
"""

OPPOSITES = {
    frozenset(pair.split())
    for pair in (
        "min max", "on off", "on no", "enable disable", "enabled disabled", "lower upper",
        "above below", "before after", "start stop", "open close", "left right", "true false",
    )
}  # fmt: skip

NOT = ("un", "non", "no", "dis")
"""Prefixes and separate words that negate a word."""

LONGEST_WORD = 64
"""Maximum length of a word in a comparison; longer words would take noticeable time."""


def closest(word: str, options: Iterable[str]) -> str | None:
    """Return the option that a mistyped word probably means; None if there is none.

    The comparison of words ignores case and the difference between `-` and `_`. A typing error is
    an additional, missing or different letter, or two swapped neighbours. A typed text of whole
    words from an option also matches this option. A typed text with a different number or with an
    opposite never matches: `ur5-003` is a different arm than `ur5-001`.
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
    """Return the end of an error message: `did you mean 'x'?`, or the list of options."""
    known = sorted(options)
    if match := closest(word, known):
        return f"did you mean {match!r}?"
    return f"available: {', '.join(known)}" if known else "none is available"


def _fold(word: str) -> str:
    return word.casefold().replace("-", "_")


def _rank(typed: str, known: str) -> int | None:
    """Return the distance of an option to the typed word; 0 if equal, None if not similar."""
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
    """Return whether two texts contain the same count of numbers, but different numbers."""
    one, other = ([n.lstrip("0") for n in _NUMBER.findall(text)] for text in (typed, known))
    return len(one) == len(other) and one != other


def _is_part(typed: str, known: str) -> bool:
    """Return whether one text contains all words of the other text, and not much more.

    The comparison ignores the order of the words.
    """
    few, many = sorted((_words(typed), _words(known)), key=lambda words: len("".join(words)))
    letters, of = "".join(few), "".join(many)
    if len(letters) < 2 or len(letters) < LEAST_SHARE * len(of):
        return False
    return letters in of or all(any(_is_word(word, other) for other in many) for word in few)


def _is_word(word: str, other: str) -> bool:
    """Return whether two words in a name match; short words must match exactly."""
    return word == other or (len(word) > LETTERS_A_SLIP and _slips(word, other) is not None)


def _slips(typed: str, known: str) -> int | None:
    """Return the number of typing errors between two words; None if too many for their length."""
    if _numbers_differ(typed, known):
        return None
    length = max(len(typed), len(known))
    most = min(max(length // LETTERS_A_SLIP, 1), MOST_SLIPS)
    if typed != known and (min(len(typed), len(known)) < 2 or abs(len(typed) - len(known)) > most):
        return None
    count = _distance(typed, known)
    return count if count <= most else None


def _distance(a: str, b: str) -> int:
    """Return the edit distance of two words, with a swap as one edit (optimal string alignment)."""
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
"""Maximum number of files of a folder that a hint names."""

NOTHING_NEAR = "is the path correct, relative to this folder?"
_MOST_LETTERS = 300


def neighbour_of(
    file: Path, endings: Iterable[str], fits: Callable[[Path], bool] = lambda _: True
) -> str:
    """Return a hint for a missing file: the missing folder, a similar name, or similar files.

    Args:
        file: Missing file.
        endings: Suffixes of the files that may be meant, such as `.urdf`.
        fits: Function that returns whether a file may be meant; raises `OSError` if this cannot be
            checked.
    """
    folder = file.parent
    wanted = tuple(endings)
    try:
        if not folder.is_dir():
            return f"there is no folder {shown(str(folder), _MOST_LETTERS)}"
        beside = [path for path in folder.iterdir() if path.suffix.casefold() in wanted]
        names = sorted(path.name for path in beside if fits(path))
    except (OSError, ValueError):  # ValueError: invalid file name
        names = []
    if match := closest(file.name, names):
        return f"did you mean {folder / match}?"
    if 0 < len(names) <= MOST_NAMED:
        return f"available: {', '.join(names)}"
    return NOTHING_NEAR


def no_file(file: Path) -> str:
    """Return, for example, the message `there is no file poses.csv in /cell`.

    If the path is absolute, the message does not contain the folder separately.
    """
    message = f"there is no file {shown(str(file), _MOST_LETTERS)}"
    if file.is_absolute():
        return message
    return f"{message} in {shown(str(Path.cwd()), _MOST_LETTERS)}"


def no_file_but(file: Path, endings: Iterable[str]) -> str:
    """Return the message of `no_file`, with the hint of `neighbour_of` if it is useful."""
    instead = neighbour_of(file, endings)
    return no_file(file) if instead == NOTHING_NEAR else f"{no_file(file)}; {instead}"
