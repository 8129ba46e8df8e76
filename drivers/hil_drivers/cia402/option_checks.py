"""What single options of an arm on CiA 402 drives may be; errors say what would be right."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.errors import SpecError
from hil.suggest import closest

Range = tuple[float, float]


def wrong_option(name: str, value: object, hint: str) -> SpecError:
    """The error that says what one option was and what would be right."""
    return SpecError(f"cia402 option {name} is {value!r}", hint=hint)


def require_known(given: Iterable[str], known: Sequence[str], where: str = "") -> None:
    """Refuse keys that there are not.

    Args:
        given: Keys as typed.
        known: All there are.
        where: Option that they belong to, such as `bus`; empty at the top.
    """
    unknown = sorted(str(name) for name in given if name not in known)
    if not unknown:
        return
    meant = [repr(like) for name in unknown if (like := closest(name, known))]
    guess = f"did you mean {', '.join(meant)}? " if meant else ""
    of = f"the option {where} of the driver cia402" if where else "the driver cia402"
    what = "key" if where else "option"
    raise SpecError(
        f"{of} has no {what} {', '.join(unknown)}",
        hint=f"{guess}its {what}s are {', '.join(known)}",
    )


def number(name: str, value: Any, between: Range, *, whole: bool = False) -> float:
    """A number in a range; ends are in it."""
    least, most = between
    right = isinstance(value, int if whole else int | float) and not isinstance(value, bool)
    if not right or not math.isfinite(value) or not least <= value <= most:
        kind = "a whole number" if whole else "a number"
        raise wrong_option(name, value, f"use {kind} from {least:.12g} to {most:.12g}")
    return value if whole else float(value)


def choice(name: str, value: Any, among: Collection[Any]) -> Any:
    """One of a few."""
    if isinstance(value, bool) or value not in among:
        like = closest(value, among) if isinstance(value, str) else None
        guess = f"did you mean {like!r}? " if like else ""
        raise wrong_option(name, value, f"{guess}use {', '.join(str(each) for each in among)}")
    return value


def truth(name: str, value: Any) -> bool:
    """Yes or no."""
    if not isinstance(value, bool):
        raise wrong_option(name, value, "use true or false")
    return value


def text(name: str, value: Any) -> str:
    """Some text, not empty."""
    if not isinstance(value, str) or not value.strip():
        raise wrong_option(name, value, "give some text")
    return value.strip()


def file(name: str, value: Any) -> str:
    """The whole path of a file that is there."""
    path = Path(text(name, value)).expanduser()
    if not path.is_file():
        raise wrong_option(name, value, f"there is no such file in {Path.cwd()}")
    return str(path.resolve())


def nodes(value: Any, n: int, master_id: int) -> tuple[int, ...]:
    """The drives' node ids in the order of the joints."""
    if not isinstance(value, list | tuple) or len(value) != n:
        raise wrong_option("nodes", value, f"list the node ids of the {n} joints, as in {_ids(n)}")
    ids = tuple(int(number("nodes", each, (1, 126), whole=True)) for each in value)
    if len(set(ids)) < n:
        raise wrong_option("nodes", list(ids), "every drive has a node id of its own")
    if master_id in ids:
        raise wrong_option(
            "nodes", list(ids), f"{master_id} is master_id, whose heartbeat the drives watch"
        )
    return ids


def period_ms(value: Any) -> int:
    """Whole milliseconds from SYNC to SYNC, which is what every drive's 60C2h can say."""
    rate = number("rate_hz", value, (4.0, 1000.0))
    period = round(1000.0 / rate)
    if not math.isclose(1000.0 / rate, period, rel_tol=1e-3):
        slower, faster = 1000.0 / math.ceil(1000.0 / rate), 1000.0 / math.floor(1000.0 / rate)
        raise wrong_option(
            "rate_hz",
            value,
            f"a cycle lasts whole milliseconds (60C2h): use {slower:.6g} or {faster:.6g}",
        )
    return period


def per_axis(name: str, value: Any, n: int) -> Sequence[Any]:
    """A value for every axis: the one that was given for all, or a list of n."""
    if not isinstance(value, list | tuple):
        return [value] * n
    if len(value) != n:
        raise wrong_option(name, value, f"give one value, or a list of {n}, one per joint")
    return value


def mapping_of(name: str, value: Any) -> Mapping[str, Any]:
    """Keys and values."""
    if not isinstance(value, Mapping):
        raise wrong_option(name, value, "give keys and values, as in {key: value}")
    return value


def _ids(n: int) -> list[int]:
    return list(range(1, n + 1))
