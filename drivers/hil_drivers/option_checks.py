"""Checks of single options of a driver; the hint of each error contains the valid values."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.core import SpecError, closest

Range = tuple[float, float]


class OptionChecks:
    """Collection of option checks for one driver.

    Args:
        driver: Name of the driver, used in error messages.
    """

    def __init__(self, driver: str) -> None:
        self._driver = driver

    def wrong_option(self, name: str, value: object, hint: str) -> SpecError:
        """Return the error that reports an invalid value of an option, with a hint."""
        return SpecError(f"{self._driver} option {name} is {value!r}", hint=hint)

    def lacking(self, name: str, hint: str) -> SpecError:
        """Return the error that reports a missing option."""
        return SpecError(f"the driver {self._driver} needs the option {name}", hint=hint)

    def require_known(self, given: Iterable[str], known: Sequence[str], where: str = "") -> None:
        """Raise if a mapping in the station file contains unknown keys.

        Args:
            given: Keys in the station file.
            known: Valid keys of the driver.
            where: Option that contains the keys, such as `bus`; empty for the options themselves.
        """
        unknown = sorted(str(name) for name in given if name not in known)
        if not unknown:
            return
        meant = [repr(like) for name in unknown if (like := closest(name, known))]
        guess = f"did you mean {', '.join(meant)}? " if meant else ""
        of = f"the option {where} of the driver" if where else "the driver"
        what = "key" if where else "option"
        raise SpecError(
            f"{of} {self._driver} has no {what} {', '.join(unknown)}",
            hint=f"{guess}its {what}s are {', '.join(known)}",
        )

    def number(self, name: str, value: Any, between: Range, *, whole: bool = False) -> float:
        """Return a number, after checking that the number is within an inclusive range."""
        least, most = between
        right = isinstance(value, int if whole else int | float) and not isinstance(value, bool)
        if not right or not math.isfinite(value) or not least <= value <= most:
            kind = "a whole number" if whole else "a number"
            raise self.wrong_option(name, value, f"use {kind} from {least:.12g} to {most:.12g}")
        return value if whole else float(value)

    def choice(self, name: str, value: Any, among: Collection[Any]) -> Any:
        """Return a value, after checking that the value is one of the valid values."""
        if isinstance(value, bool) or value not in among:
            like = closest(value, among) if isinstance(value, str) else None
            guess = f"did you mean {like!r}? " if like else ""
            raise self.wrong_option(
                name, value, f"{guess}use {', '.join(str(each) for each in among)}"
            )
        return value

    def truth(self, name: str, value: Any) -> bool:
        """Return a value, after checking that the value is a boolean."""
        if not isinstance(value, bool):
            raise self.wrong_option(name, value, "use true or false")
        return value

    def text(self, name: str, value: Any) -> str:
        """Return a text without surrounding spaces, after checking that the text is not empty."""
        if not isinstance(value, str) or not value.strip():
            raise self.wrong_option(name, value, "use a non-empty text")
        return value.strip()

    def file(self, name: str, value: Any) -> str:
        """Return the absolute path of a file, after checking that the file exists."""
        path = Path(self.text(name, value)).expanduser()
        if not path.is_file():
            raise self.wrong_option(
                name, value, f"the file does not exist (relative to {Path.cwd()})"
            )
        return str(path.resolve())

    def per_axis(self, name: str, value: Any, n: int) -> Sequence[Any]:
        """Return n values, one per axis, from one common value or from a list of n values."""
        if not isinstance(value, list | tuple):
            return [value] * n
        if len(value) != n:
            raise self.wrong_option(name, value, f"give one value, or a list of {n}, one per joint")
        return value

    def mapping_of(self, name: str, value: Any) -> Mapping[str, Any]:
        """Return a value, after checking that the value is a mapping."""
        if not isinstance(value, Mapping):
            raise self.wrong_option(name, value, "give keys and values, as in {key: value}")
        return value
