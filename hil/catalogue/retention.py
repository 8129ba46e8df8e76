"""Which runs a policy lets go, and why the others stay. Nothing is deleted here."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from hil.campaign.series_folder import SeriesFolder, is_series_folder
from hil.catalogue.facts import started_s
from hil.catalogue.origins import Lost, Origins, origins
from hil.catalogue.trained_rows import why_by_rows
from hil.catalogue.view import find_runs
from hil.errors import DataError, SpecError
from hil.record.numbering import folders_in, run_folders
from hil.record.rundir import RunDirectory
from hil.spec.durations import duration_text


@dataclass(frozen=True, slots=True)
class Policy:
    """What is let go; whatever is asked must hold.

    Attributes:
        terms: Of a query: no other run is looked at.
        older: Runs that were started longer ago.
        keep: Runs after which so many of the same robot and experiment were completed.
        interrupted: Also runs that were interrupted.
        recordings_only: Documents, models and reports stay.
    """

    terms: tuple[str, ...] = ()
    older: timedelta | None = None
    keep: int | None = None
    interrupted: bool = False
    recordings_only: bool = False

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "query": list(self.terms),
            "older_than": None if self.older is None else duration_text(self.older),
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
    newer = _completed_after(entries)
    at = time.time() if now is None else now
    found = [
        _guarded(Path(run["run"]), run, known, policy)
        or _by_policy(Path(run["run"]), run, policy, newer[run["run"]], at)
        for run in entries
    ]
    known_by_rows = why_by_rows(_lost(known, runs))
    found = [_unless(one, known_by_rows) if one.goes else one for one in found]
    together = _with_their_series(found, _series(runs))
    return [one for one in together if str(one.run) in asked]


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
        return Decision(run, f"it is younger than {duration_text(policy.older)}")
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


def _completed_after(entries: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Run → how many of its robot and experiment were completed after it."""
    count: Counter[tuple[str, str]] = Counter()
    newer: dict[str, int] = {}
    for run in sorted(entries, key=lambda one: (started_s(one) or 0.0, one["number"]))[::-1]:
        kind = (run["robot"], run["name"])
        newer[run["run"]] = count[kind]
        count[kind] += run["status"] == "completed"
    return newer


def _series(runs: Path) -> list[tuple[str, set[Path]]]:
    """Name and runs of every series.

    Raises:
        DataError: One cannot be read.
    """
    found = []
    folders = [path for day in folders_in(runs) for path in folders_in(day / "series")]
    for path in filter(is_series_folder, folders):
        try:
            folder, members = SeriesFolder.open(path)
        except DataError as error:
            hint = "nothing is deleted before; its folder is a view and may be moved away"
            raise DataError(error.message, hint=hint) from error
        paths = {Path(one["run"]).resolve() for one in members if isinstance(one.get("run"), str)}
        found.append((folder.path.name, paths))
    return found


def _with_their_series(
    decisions: list[Decision], series: list[tuple[str, set[Path]]]
) -> list[Decision]:
    """Runs of a series of which one has to stay, stay with it."""
    guarded = {one.run.resolve(): one for one in decisions if one.guarded}
    kept: dict[Path, str] = {}
    for name, members in series:
        for member in members & guarded.keys():
            run = guarded[member]
            kept |= dict.fromkeys(members, f"it is of {name}, as {run.run.name}: {run.why}")
    return [
        replace(one, why=kept[path], guarded=True, size=0)
        if not one.guarded and (path := one.run.resolve()) in kept
        else one
        for one in decisions
    ]
