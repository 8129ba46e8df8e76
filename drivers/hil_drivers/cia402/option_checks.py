"""What single options of an arm on CiA 402 drives may be; errors say what would be right."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hil_drivers.option_checks import OptionChecks, Range

__all__ = ["Range"]

_CHECKS = OptionChecks("cia402")
wrong_option, require_known = _CHECKS.wrong_option, _CHECKS.require_known
number, choice, truth = _CHECKS.number, _CHECKS.choice, _CHECKS.truth
text, file = _CHECKS.text, _CHECKS.file
per_axis, mapping_of = _CHECKS.per_axis, _CHECKS.mapping_of


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


def log_file(name: str, value: Any) -> str:
    """The whole path of a file that can be made."""
    path = Path(text(name, value)).expanduser().absolute()
    if not path.parent.is_dir():
        raise wrong_option(name, value, f"there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise wrong_option(name, value, "this is a folder; give a file in it")
    return str(path)


def _ids(n: int) -> list[int]:
    return list(range(1, n + 1))
