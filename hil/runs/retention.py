"""Which runs a policy lets go, and why the others stay. Nothing is deleted here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from hil.core import SpecError, duration_text
from hil.recording import RunDirectory, run_folders
from hil.runs.facts import started_s
from hil.runs.newest import measured_after
from hil.runs.origins import Lost, Origins, origins
from hil.runs.together import groups
from hil.runs.trained_rows import why_by_rows
from hil.runs.view import find_runs


@dataclass(frozen=True, slots=True)
class Policy:
    """What is let go; whatever is asked must hold.

    Attributes:
        terms: Of a query: no other run is looked at.
        older: Runs that were started longer ago.
        keep: Runs after which so many of the same robot and experiment were measured in full.
        interrupted: Also runs that were interrupted.
        recordings_only: Documents, models and reports stay.
        typed: `older` as somebody typed it, if so.
    """

    terms: tuple[str, ...] = ()
    older: timedelta | None = None
    keep: int | None = None
    interrupted: bool = False
    recordings_only: bool = False
    typed: str = ""

    @property
    def age(self) -> str:
        """The age that is asked for, in words; empty where none is."""
        return self.typed or ("" if self.older is None else duration_text(self.older))

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "query": list(self.terms),
            "older_than": self.age or None,
            "keep": self.keep,
            "interrupted": self.interrupted,
            "recordings_only": self.recordings_only,
        }


@dataclass(frozen=True, slots=True)
class Decision:
    """What is to become of one run.

    Attributes:
        run: Its directory.
        why: Why it stays; empty when it goes.
        guarded: It stays whatever the policy says.
        size: Of what would be deleted [bytes].
    """

    run: Path
    why: str = ""
    guarded: bool = False
    size: int = 0

    @property
    def goes(self) -> bool:
        """The policy lets it go, and nothing speaks against it."""
        return not self.why

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"run": str(self.run), "goes": self.goes, "why": self.why, "bytes": self.size}


def decide(
    runs: Path, policy: Policy, registries: Iterable[Path], now: float | None = None
) -> list[Decision]:
    """What a policy comes to, run by run, oldest number first.

    Args:
        runs: The folder of runs.
        policy: What may go.
        registries: Folders of models; each must be there.
        now: For ages [s, Unix]; by default the present moment.

    Raises:
        SpecError: The policy lets everything go, or a term cannot be understood.
        RegistryError: A registry cannot be read: then nothing may go.
        DataError: The document of a series or of a run cannot be read.
    """
    if policy.older is None and policy.keep is None:
        raise SpecError(
            "this policy would let every run go",
            hint="say which may: --older-than 180d, --keep 20 (of a robot and experiment), or both",
        )
    known = origins(registries)
    asked = {run["run"] for run in find_runs(*policy.terms, runs=runs)}
    entries = find_runs(runs=runs)
    newer = measured_after(entries)
    at = time.time() if now is None else now
    found = [
        _linked(Path(run["run"]), policy)
        or _guarded(Path(run["run"]), run, known, policy)
        or _by_policy(Path(run["run"]), run, policy, newer[run["run"]], at)
        for run in entries
    ]
    known_by_rows = why_by_rows(_lost(known, runs))
    found = [_unless(one, known_by_rows) if one.goes else one for one in found]
    together = _with_their_others(found, groups(runs, [one.run for one in found]))
    return [one for one in together if str(one.run) in asked]


def why_link(run: Path, policy: Policy) -> str:
    """Why a run that is reached over a link stays; empty where none is on the way.

    What a link leads to is no policy's business, and if it lies here it is a run of its own.
    """
    if any(part.is_symlink() for part in (run, *run.parents[:2])):  # DAY/ROBOT/RUN
        return "it is a link"
    if policy.recordings_only and (run / "recording").is_symlink():
        return "its recordings are a link"
    return ""


def guard(run: Path, facts: Mapping[str, Any], known: Origins, policy: Policy) -> str:
    """Why a run stays whatever a policy says; empty where nothing speaks for it.

    Raises:
        DataError: Its documents cannot be read.
    """
    if facts["status"] == "running":
        return "it is live"
    if facts["status"] == "damaged":
        return f"it is damaged, what it was is unknown: {facts['problem']}"
    if why := known.why(run, facts):
        return why
    if facts["status"] == "interrupted" and not policy.interrupted:
        return f"it was interrupted: hil resume {run}, or let it go with --interrupted"
    return ""


def _linked(run: Path, policy: Policy) -> Decision | None:
    why = why_link(run, policy)
    return Decision(run, why) if why else None


def _guarded(
    run: Path, facts: Mapping[str, Any], known: Origins, policy: Policy
) -> Decision | None:
    why = guard(run, facts, known, policy)
    return Decision(run, why, guarded=True) if why else None


def _by_policy(
    run: Path, facts: dict[str, Any], policy: Policy, newer: int, now: float
) -> Decision:
    if policy.keep is not None and newer < policy.keep:
        return Decision(run, f"it is among the newest {policy.keep} of {facts['name']}")
    begun = started_s(facts)
    if policy.older is not None and (begun is None or now - begun < policy.older.total_seconds()):
        return Decision(run, f"it is younger than {policy.age}")
    if policy.recordings_only and not RunDirectory(run).recordings:
        return Decision(run, "it has no recording")
    return Decision(run, size=size_of(run, policy))


def _lost(known: Origins, runs: Path) -> list[Lost]:
    """Versions that were fitted to a run which is not there by that name."""
    there = {path.name for path in run_folders(runs)}
    return [one for one in known.by_name if one.name not in there]


def _unless(decision: Decision, why: Callable[[Path], str]) -> Decision:
    told = why(decision.run)
    return Decision(decision.run, told, guarded=True) if told else decision


def size_of(run: Path, policy: Policy) -> int:
    """Bytes that go with a run."""
    folder = run / "recording" if policy.recordings_only else run
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())


def _with_their_others(
    decisions: list[Decision], belonging: list[tuple[str, set[Path]]]
) -> list[Decision]:
    """Runs of a series or fleet of which one has to stay, stay with it."""
    guarded = {one.run.resolve(): one for one in decisions if one.guarded}
    kept: dict[Path, str] = {}
    for name, members in belonging:
        for member in members & guarded.keys():
            run = guarded[member]
            kept |= dict.fromkeys(members, f"it is of {name}, as {run.run.name}: {run.why}")
    return [
        replace(one, why=kept[path], guarded=True, size=0)
        if not one.guarded and (path := one.run.resolve()) in kept
        else one
        for one in decisions
    ]
