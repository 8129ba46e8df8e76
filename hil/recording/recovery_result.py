"""What a recovery kept and what is lost: as data, as JSON and in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from hil.recording.salvage import Damage, Salvage

Did = Literal["nothing", "renamed", "rebuilt", "empty", "discarded"]

_MOST_DAMAGES_TOLD = 5
_LAST_SECOND_OF_9999 = 253402300799.0


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of one file.

    Attributes:
        path: The file as it was given.
        did: `nothing`, because it is whole; `renamed`, because only its name was missing;
            `rebuilt`; `empty`, rebuilt too, but it never got a message; or `discarded`, because
            it had been rebuilt before.
        out: The whole file.
        torn: Where the torn file is now; None when there is none any more.
        problem: Where and why it was torn or damaged, empty when it was whole.
        lost_bytes: From the tear to the end of the file.
        salvage: What was kept and what was damaged before the tear.
    """

    path: Path
    did: Did
    out: Path
    torn: Path | None = None
    problem: str = ""
    lost_bytes: int = 0
    salvage: Salvage = field(default_factory=Salvage)

    def to_dict(self) -> dict[str, Any]:
        """JSON form; times are Unix time [s]."""
        return {
            "file": str(self.path),
            "did": self.did,
            "out": str(self.out),
            "torn": str(self.torn) if self.torn else None,
            "problem": self.problem,
            "lost_bytes": self.lost_bytes,
            "kept": [kept.to_dict() for kept in kept_by_topic(self.salvage)],
            "damaged": [_damage_to_dict(damage) for damage in self.salvage.damages],
            "damaged_records": self.salvage.damaged,
            "orphaned_messages": self.salvage.orphans,
            "wrong_indexes": self.salvage.misindexed,
        }

    def to_lines(self) -> list[str]:
        """The same in words, for people."""
        if self.did == "nothing" and self.path != self.out:
            return [f"{self.path} was recovered before: {self.out} holds all that is whole in it"]
        if self.did == "nothing":
            return [f"{self.path} is whole: {_told(self.salvage)}"]
        if self.did == "renamed":
            return [f"{self.path} is whole, only its name was not: it is {self.out} now"]
        if self.did == "discarded":
            return [f"{self.path} is deleted: {self.out} holds all that is whole in it"]
        lines = [f"{self.path} is {self.problem}"]
        if self.did == "empty":
            told = "nothing: the kill came before its first samples reached it"
            return [*lines, f"  lost  {told}", f"  → {self.out}, an empty recording"]
        lines += [f"  kept  {kept.to_line()}" for kept in kept_by_topic(self.salvage)]
        lines += [f"  lost  {line}" for line in self._lost()]
        kept = f"; the torn file is {self.torn}" if self.torn else "; the torn file is deleted"
        return [*lines, f"  → {self.out}, read back and equal{kept}"]

    def _lost(self) -> list[str]:
        found = self.salvage
        lines = [f"{self.lost_bytes} bytes behind the tear"] if self.lost_bytes else []
        if lines and found.ended:
            lines = [f"no message: the tear is in the index ({self.lost_bytes} bytes)"]
        lines += [_damage_in_words(damage) for damage in found.damages[:_MOST_DAMAGES_TOLD]]
        if (more := found.damaged - _MOST_DAMAGES_TOLD) > 0:
            lines.append(f"… and {more} more damaged records")
        if found.orphans:
            lines.append(f"{found.orphans} messages of which nothing says what they are")
        if found.misindexed:
            lines.append(f"nothing by {found.misindexed} wrong message indexes: they are made anew")
        return lines or ["nothing"]


@dataclass(frozen=True, slots=True)
class TopicKept:
    """What was kept of one topic; times are log times [s, Unix]."""

    topic: str
    messages: int
    first_s: float
    last_s: float

    def to_dict(self) -> dict[str, Any]:
        """JSON form; times are null where there is no message."""
        some = self.messages > 0
        return {
            "topic": self.topic,
            "messages": self.messages,
            "from": self.first_s if some else None,
            "to": self.last_s if some else None,
        }

    def to_line(self) -> str:
        """In words."""
        told = f"{self.messages} messages of {self.topic}"
        return f"{told}, {_span(self.first_s, self.last_s)}" if self.messages else told


def kept_by_topic(salvage: Salvage) -> list[TopicKept]:
    """By topic, channels of the same one added up."""
    out: dict[str, TopicKept] = {}
    for definition, kept in salvage.tally.channels.items():
        first, last = (kept.first_ns * 1e-9, kept.last_ns * 1e-9) if kept.messages else _NEVER
        one = out.get(definition.topic, TopicKept(definition.topic, 0, *_NEVER))
        out[definition.topic] = TopicKept(
            definition.topic,
            one.messages + kept.messages,
            min(one.first_s, first),
            max(one.last_s, last),
        )
    return [out[topic] for topic in sorted(out)]


_NEVER = (math.inf, -math.inf)


def _told(salvage: Salvage) -> str:
    return ", ".join(f"{k.messages} messages of {k.topic}" for k in kept_by_topic(salvage))


def _damage_to_dict(damage: Damage) -> dict[str, Any]:
    return {
        "at_byte": damage.offset,
        "bytes": damage.length,
        "what": damage.what,
        "from": damage.first_ns * 1e-9 or None,
        "to": damage.last_ns * 1e-9 or None,
    }


def _damage_in_words(damage: Damage) -> str:
    told = f"{damage.what} at byte {damage.offset}, {damage.length} bytes"
    span = _span(damage.first_ns * 1e-9, damage.last_ns * 1e-9)
    return f"{told}, by its head {span}" if damage.last_ns else told


def _span(first_s: float, last_s: float) -> str:
    """From when to when, in local time where it can be one."""
    if not 0 < first_s <= last_s < _LAST_SECOND_OF_9999:
        return f"{first_s:.3f} s to {last_s:.3f} s"
    first, last = (datetime.fromtimestamp(t).astimezone() for t in (first_s, last_s))
    ends = f"{last:%H:%M:%S}" if first.date() == last.date() else f"{last:%Y-%m-%d %H:%M:%S}"
    return f"{first:%Y-%m-%d %H:%M:%S} to {ends} ({last_s - first_s:.1f} s)"
