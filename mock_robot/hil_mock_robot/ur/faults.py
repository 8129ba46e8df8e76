"""What is to go wrong with a mock UR controller, and when: `--faults FILE` and the side channel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from hil.errors import SpecError

KINDS: dict[str, tuple[str, ...]] = {
    "cut": ("for_s", "only"),
    "unplugged": ("for_s",),
    "silence": ("for_s",),
    "jitter": ("by_s", "for_s"),
    "late": ("by_s", "for_s"),
    "freeze": ("for_s",),
    "drop": ("packages",),
    "duplicate": ("packages",),
    "wrong_length": ("packages", "by_bytes"),
    "garbage": ("packages",),
    "protective_stop": ("code",),
    "emergency_stop": (),
    "safeguard_stop": ("for_s",),
    "safety_fault": (),
    "overheat": ("joint", "celsius"),
    "reboot": ("for_s", "powered"),
    "inputs_owned": ("for_s",),
    "remote_off": ("for_s",),
    "payload_refused": ("for_s",),
    "dashboard_hang": ("for_s",),
}
"""What can go wrong, and which further keys each kind has (docs/reference/mock-ur-faults.md)."""

COUNTED = ("motion", "program")
WHEN = ("at_s", *COUNTED, "after_s")
REQUIRED = {"jitter": "by_s", "late": "by_s"}
OWN_DURATION = {"cut": 0.0, "reboot": 3.0}
"""How long these last when nothing is said; the others last until they are cleared."""

OWNERS = "inputs"
"""Of the connections, those whose client has inputs of RTDE."""

ROUNDING = 1e-6
LONGEST_S = 1e9
"""Three decades: what is later never happens, and ticks until then can still be counted."""

_NUMBERS: dict[str, tuple[float, float, bool, str]] = {
    "at_s": (0, LONGEST_S, False, "a number of seconds from 0 to 1e9"),
    "after_s": (0, LONGEST_S, False, "a number of seconds from 0 to 1e9"),
    "for_s": (0, LONGEST_S, False, "a number of seconds from 0 to 1e9; nothing for ever"),
    "by_s": (0, 60, False, "a number of seconds from 0 to 60"),
    "motion": (1, math.inf, True, "a whole number from 1 up"),
    "program": (1, math.inf, True, "a whole number from 1 up"),
    "packages": (1, math.inf, True, "a whole number from 1 up"),
    "by_bytes": (-1000, 1000, True, "a whole number of bytes, −1000 to 1000"),
    "code": (100, 999, True, "a UR error code, 100 to 999"),
    "joint": (1, 6, True, "a joint from 1, the base, to 6"),
    "celsius": (-50, 200, False, "a temperature from −50 to 200 °C"),
}
"""Least, most, whether it is whole, and how to say so."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong, once.

    Attributes:
        kind: One of `KINDS`.
        at_s: Time since the mock was started at which it begins, in device time.
        motion, program: Which motion or program it follows, counted from 1.
        after_s: Device time since that began.
        for_s: Device time it lasts.
        by_s: How late packages come, or how late at most.
        packages: How many are lost, sent twice or spoilt, for each client that is connected.
        by_bytes: How much too long they are.
        code: UR's number C… of the protective stop.
        joint: From 1, the base, to 6.
        celsius: How hot it is at once.
        only: `inputs`: of the connections, only those that own inputs are cut, and once.
        powered: Whether the arm is switched on after the reboot.
    """

    kind: str
    at_s: float | None = None
    motion: int | None = None
    program: int | None = None
    after_s: float = 0.0
    for_s: float = math.inf
    by_s: float = 0.0
    packages: int = 1
    by_bytes: int = -8
    code: int = 158
    joint: int = 2
    celsius: float = 90.0
    powered: bool = False
    only: str = ""


def read_faults(path: Path) -> tuple[Fault, ...]:
    """The faults of a YAML file: `faults:` and a list, or the list alone.

    Raises:
        SpecError: It cannot be read, or a fault in it cannot be.
    """
    try:
        given = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, UnicodeError, yaml.YAMLError) as error:
        raise SpecError(
            f"{path}: {error}", hint="give a YAML file with a list of faults"
        ) from error
    if isinstance(given, Mapping) and set(given) == {"faults"}:
        given = given["faults"]
    try:
        return faults_of(given)
    except SpecError as error:
        raise SpecError(f"{path}: {error.message}", hint=error.hint) from error


def faults_of(given: Any) -> tuple[Fault, ...]:
    """The faults of a list.

    Raises:
        SpecError: One is unknown or cannot be; the message names it.
    """
    if isinstance(given, str | Mapping) or not isinstance(given, Sequence):
        raise SpecError(f"faults is {given!r}", hint="give a list: [{kind: silence, at_s: 2.0}]")
    faults = tuple(fault_of(f"faults[{i}]", entry) for i, entry in enumerate(given))
    for i, (entry, fault) in enumerate(zip(given, faults, strict=True)):
        if fault.at_s is None and fault.motion is None and fault.program is None:
            raise _wrong(f"faults[{i}]", entry, "say when: at_s, motion or program")
    return faults


def fault_of(where: str, given: Any) -> Fault:
    """One fault; without a time it begins now.

    Raises:
        SpecError: It is unknown or cannot be.
    """
    kind = given.get("kind") if isinstance(given, Mapping) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise _wrong(where, given, f"give kind: one of {', '.join(KINDS)}")
    where = f"{where} ({kind})"
    keys = (*WHEN, *KINDS[kind])
    unknown = sorted(str(key) for key in set(given) - {"kind", *keys})
    if unknown:
        raise SpecError(f"{where} has no key {unknown[0]}", hint=f"this kind has {', '.join(keys)}")
    _require_when(where, given)
    if kind in REQUIRED and REQUIRED[kind] not in given:
        raise SpecError(f"{where} lacks {REQUIRED[kind]}", hint="say by how many seconds")
    values = {key: _value_of(f"{where}.{key}", key, given[key]) for key in given if key != "kind"}
    return replace(Fault(kind, for_s=OWN_DURATION.get(kind, math.inf)), **values)


def _require_when(where: str, given: Mapping[str, Any]) -> None:
    if sum(key in given for key in ("at_s", *COUNTED)) > 1:
        raise _wrong(where, dict(given), "give one of at_s, motion and program")
    if "after_s" in given and not any(key in given for key in COUNTED):
        raise _wrong(
            f"{where}.after_s", given["after_s"], "it counts from the start of a motion or program"
        )


def _value_of(where: str, key: str, value: Any) -> Any:
    if key == "powered":
        if not isinstance(value, bool):
            raise _wrong(where, value, "use true or false")
        return value
    if key == "only":
        if value != OWNERS:
            raise _wrong(where, value, f"use {OWNERS}, or leave it away to cut all connections")
        return value
    least, most, whole, words = _NUMBERS[key]
    kinds = int if whole else (int, float)
    if key == "for_s" and value == math.inf:
        return math.inf
    if not isinstance(value, kinds) or isinstance(value, bool) or not least <= value <= most:
        raise _wrong(where, value, f"use {words}")
    return value if whole else float(value)


def _wrong(where: str, value: object, hint: str) -> SpecError:
    return SpecError(f"{where} is {value!r}", hint=hint)
