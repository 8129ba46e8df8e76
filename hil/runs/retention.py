"""Retention of runs: selects the runs that a policy deletes, explains the rest, and deletes runs.

The function `decide` deletes nothing and returns one decision per run. If several reasons for
keeping a run apply, the strongest reason is reported. The strongest reason is a symbolic link that
leads to the run. The next strongest reason is that the run is live, damaged or interrupted, or that
a model was fitted to the run (`hil.runs.origins`). Reasons of medium strength are the criteria of
the policy. The weakest reason is that the run belongs to a series or fleet in which another run is
kept, because the runs of a group are useful only together.

The function `remove` checks each run again immediately before the deletion. A run that is deleted
is first renamed to a name that all listings ignore. Therefore, if the process is killed, no partly
deleted run looks like a complete run. The next deletion also deletes the folders that a killed
deletion left behind (`leftovers`).
"""

from __future__ import annotations

import contextlib
import shutil
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any

from hil.core import (
    DataError,
    RecordingError,
    SpecError,
    duration_text,
    fsync_directory,
    hold_run,
    read_json,
)
from hil.recording import (
    PRUNED,
    FleetGroup,
    RunDirectory,
    SeriesGroup,
    folders_in,
    operator,
    run_folders,
    unreadable_folders,
    utc_now,
)
from hil.runs.catalogue import find_runs
from hil.runs.listing import facts_of, started_s
from hil.runs.origins import Origins, origins, why_by_rows


@dataclass(frozen=True, slots=True)
class Policy:
    """Retention policy: a run may be deleted only if it meets all criteria.

    Attributes:
        terms: Query terms (`hil.runs.query`) that a run must match.
        older: Minimum age of a run, measured from the start of the run.
        keep: Minimum number of newer completed runs of the same robot and experiment.
        interrupted: Whether interrupted runs may also be deleted.
        recordings_only: Whether only recordings are deleted, while documents, models and reports
            are kept.
        typed: Text that the user typed for `older`; empty if the user typed none.
    """

    terms: tuple[str, ...] = ()
    older: timedelta | None = None
    keep: int | None = None
    interrupted: bool = False
    recordings_only: bool = False
    typed: str = ""

    @property
    def age(self) -> str:
        """Minimum age as text; empty if the policy has no minimum age."""
        return self.typed or ("" if self.older is None else duration_text(self.older))

    def to_dict(self) -> dict[str, Any]:
        """Return the policy as a JSON-compatible dictionary."""
        return {
            "query": list(self.terms),
            "older_than": self.age or None,
            "keep": self.keep,
            "interrupted": self.interrupted,
            "recordings_only": self.recordings_only,
        }


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision whether one run is to be deleted.

    Attributes:
        run: Path of the run directory.
        why: Reason for keeping the run; empty if the run is to be deleted.
        guarded: Whether the run is kept regardless of the policy.
        size: Total size of the files that would be deleted [bytes].
    """

    run: Path
    why: str = ""
    guarded: bool = False
    size: int = 0

    @property
    def goes(self) -> bool:
        """Whether the run is to be deleted; true if there is no reason for keeping the run."""
        return not self.why

    def to_dict(self) -> dict[str, Any]:
        """Return the decision as a JSON-compatible dictionary."""
        return {"run": str(self.run), "goes": self.goes, "why": self.why, "bytes": self.size}


def decide(
    runs: Path, policy: Policy, registries: Iterable[Path], now: float | None = None
) -> list[Decision]:
    """Return the decisions of a policy on all runs that its query selects, sorted by run number.

    Args:
        runs: Path of the folder of runs.
        policy: Retention policy that is applied.
        registries: Paths of the registry folders; each folder must exist.
        now: Reference time for ages [s, Unix time]; defaults to the current time.

    Raises:
        SpecError: The policy would delete every run, or a query term cannot be parsed.
        RegistryError: A registry cannot be read; in this case, no run may be deleted.
        DataError: A folder below `runs`, or the document of a series or of a run, cannot be read.
    """
    if policy.older is None and policy.keep is None:
        raise SpecError(
            "this policy would delete every run",
            hint="limit it: --older-than 180d, --keep 20 (newest of each robot and experiment), "
            "or both",
        )
    _require_readable(runs)
    known = origins(registries)
    queried = {run["run"] for run in find_runs(*policy.terms, runs=runs)}
    # Decide on every run: one outside the query can protect the others of its group.
    entries = find_runs(runs=runs)
    newer = _measured_after(entries)
    at = time.time() if now is None else now
    decisions = []
    for facts in entries:
        run = Path(facts["run"])
        if why := _why_link(run, policy):
            decisions.append(Decision(run, why))
        elif why := _guard(run, facts, known, policy):
            decisions.append(Decision(run, why, guarded=True))
        else:
            decisions.append(_by_policy(run, facts, policy, newer[facts["run"]], at))
    # Only for runs still selected: recognizing a run by its rows requires reading all samples.
    names = {path.name for path in run_folders(runs)}
    by_rows = why_by_rows(one for one in known.by_name if one.name not in names)
    for k, one in enumerate(decisions):
        if one.goes and (why := by_rows(one.run)):
            decisions[k] = Decision(one.run, why, guarded=True)
    groups = [*_series(runs), *_fleets(runs, [one.run for one in decisions])]
    return [one for one in _keep_groups(decisions, groups) if str(one.run) in queried]


def _require_readable(runs: Path) -> None:
    """Raise if one of the folders of runs, series or fleets cannot be read.

    An unreadable folder possibly contains a series or fleet that protects other runs.
    """
    refused = unreadable_folders(runs) + SeriesGroup.unreadable(runs) + FleetGroup.unreadable(runs)
    if refused:
        raise DataError(
            "\n".join(f"cannot read {folder}: {why}" for folder, why in refused),
            hint="check the permissions; nothing is deleted until this can be read, because a "
            "series or fleet in it may protect other runs",
        )


def _measured_after(entries: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Return the number of later completed runs of the same robot and experiment, by run path.

    Args:
        entries: Entries of the runs, as returned by `hil.runs.catalogue.find_runs`.
    """
    count: Counter[tuple[str, str]] = Counter()
    newer: dict[str, int] = {}
    by_identity: dict[str, int] = {}  # a link to a run or a copy of it counts once
    for run in sorted(entries, key=lambda one: (started_s(one) or 0.0, one["number"]))[::-1]:
        kind, identity = (run["robot"], run["name"]), run["uid"] or run["run"]
        if identity not in by_identity:
            by_identity[identity] = count[kind]
            count[kind] += _in_full(run)
        newer[run["run"]] = by_identity[identity]
    return newer


def _in_full(facts: Mapping[str, Any]) -> bool:
    """Return whether a run counts as a newer completed run that replaces an older run.

    Only a completed run with recordings can replace an older run, except if the run was rejected or
    is a commissioning run.
    """
    run = Path(facts["run"])
    good = facts["status"] == "completed" and facts["verdict"] != "rejected"
    return good and bool(RunDirectory(run).recordings) and "commissioning" not in _start_of(run)


def _start_of(run: Path) -> Mapping[str, Any]:
    """Return the start document of a run; empty if the document is damaged."""
    try:
        return read_json(run / "start.json")
    except DataError:
        return {}


def _why_link(run: Path, policy: Policy) -> str:
    """Return the reason for keeping a run to which a symbolic link leads; empty without a link.

    The target of a link is possibly outside the folder of runs. A target inside the folder of runs
    is listed as a separate run.
    """
    if any(part.is_symlink() for part in (run, *run.parents[:2])):  # DAY/ROBOT/RUN
        return "it is a link"
    if policy.recordings_only and (run / "recording").is_symlink():
        return "its recordings are a link"
    return ""


def _guard(run: Path, facts: Mapping[str, Any], known: Origins, policy: Policy) -> str:
    """Return the reason for keeping a run regardless of the policy; empty without a reason.

    Raises:
        DataError: The documents of the run cannot be read.
    """
    if facts["status"] == "running":
        return "it is live"
    if facts["status"] == "damaged":
        return f"it is damaged and its content is unknown: {facts['problem']}"
    if why := known.why(run, facts):
        return why
    if facts["status"] == "interrupted" and not policy.interrupted:
        return f"it was interrupted: hil resume {run}, or delete it with --interrupted"
    return ""


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
    return Decision(run, size=_size_of(run, policy))


def _size_of(run: Path, policy: Policy) -> int:
    """Return the total size of the files that the deletion of a run would delete [bytes]."""
    folder = run / "recording" if policy.recordings_only else run
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())


def _series(runs: Path) -> list[tuple[str, set[Path]]]:
    """Return the name and the paths of the run directories of each series."""
    groups = []
    for path in filter(SeriesGroup.is_at, SeriesGroup.folders(runs)):
        try:
            members = SeriesGroup.open(path).members()
        except DataError as error:
            hint = (
                "nothing is deleted until the series can be read; repair its folder or move it "
                "away: it contains no runs"
            )
            raise DataError(error.message, hint=hint) from error
        groups.append((path.name, {one.run.resolve() for one in members if one.run is not None}))
    return groups


def _fleets(runs: Path, paths: Iterable[Path]) -> list[tuple[str, set[Path]]]:
    """Return the name and the run directories of each fleet, as stored in the runs themselves."""
    known = {path.parts[-3:] for path in FleetGroup.folders(runs)}  # DAY/fleet/fleet-NAME
    groups: defaultdict[tuple[str, ...], set[Path]] = defaultdict(set)
    for run in paths if known else ():
        if (fleet := FleetGroup.place_named_by(run)) in known:
            groups[fleet].add(run.resolve())
    return [(name, members) for (*_, name), members in groups.items()]


def _keep_groups(decisions: list[Decision], groups: list[tuple[str, set[Path]]]) -> list[Decision]:
    """Return the decisions, changed so that a guarded run also guards its series or fleet."""
    guarded = {one.run.resolve(): one for one in decisions if one.guarded}
    reasons: dict[Path, str] = {}
    for name, members in groups:
        for member in members & guarded.keys():
            one = guarded[member]
            reasons |= dict.fromkeys(
                members, f"it belongs to {name}, whose run {one.run.name} stays: {one.why}"
            )
    return [
        replace(one, why=reasons[path], guarded=True, size=0)
        if not one.guarded and (path := one.run.resolve()) in reasons
        else one
        for one in decisions
    ]


TRASH = ".trash-"
"""Prefix for names of folders that are being deleted; names of runs never start with a dot."""


def remove(
    decisions: Iterable[Decision],
    runs: Path,
    policy: Policy,
    registries: Iterable[Path],
    tell: Callable[[Decision], None] = lambda _: None,
) -> list[Decision]:
    """Check the runs that are to be deleted again, and delete them.

    Args:
        decisions: Decisions on the runs, as returned by `hil.runs.retention.decide`.
        runs: Path of the folder of runs.
        policy: Retention policy on which the decisions are based.
        registries: Paths of the registry folders, which are read again for every run.
        tell: Callback that is called after each deletion with the decision on the deleted run.

    Returns:
        Final decisions. A run is kept if it has become live, or has been used for a model, since
        the decision.

    Raises:
        RegistryError: One of the registries cannot be read.
        RecordingError: The file system does not permit a deletion.
    """
    for left in leftovers(runs):
        shutil.rmtree(left, ignore_errors=True)
    registries, done = list(registries), []
    for one in decisions:
        why = _remove(one.run, policy, registries) if one.goes else one.why
        done.append(Decision(one.run, why, guarded=one.guarded, size=one.size))
        if one.goes and not why:
            tell(one)
    return done


def _remove(run: Path, policy: Policy, registries: list[Path]) -> str:
    """Delete a run and return an empty text, or return the reason for keeping the run."""
    if why := _why_link(run, policy):
        return why
    with _refused(run, "none of its files has been deleted"):
        try:
            with hold_run(run):
                # The lock held here makes the run look live, so its own status is used.
                facts = facts_of(run) | {"status": RunDirectory.open(run).status}
                if why := _guard(run, facts, origins(registries), policy):
                    return why
                if not policy.recordings_only:
                    trash = _renamed(run)
                else:
                    directory = RunDirectory(run)
                    if not (run / PRUNED).exists():  # written by a killed deletion otherwise
                        directory.write_json(PRUNED, _pruned_document(directory, policy))
                    trash = _renamed(run / "recording")
        except DataError as error:
            return error.message
    with _refused(trash, "the next hil prune --yes deletes the remaining files"):
        shutil.rmtree(trash)
    if not policy.recordings_only:
        _remove_empty_parents(run)
    return ""


@contextlib.contextmanager
def _refused(folder: Path, state: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot delete {folder}: {error.strerror or error}",
            hint=f"check its permissions; {state}",
        ) from error


def _pruned_document(directory: RunDirectory, policy: Policy) -> dict[str, Any]:
    """Return the content of `pruned.json` for the recordings that are about to be deleted."""
    sizes = {
        path.relative_to(directory.path).as_posix(): path.stat().st_size
        for path in sorted((directory.path / "recording").rglob("*"))
        if path.is_file()
    }
    return {
        "hil_pruned": 1,
        "at": utc_now(),
        "by": operator(),
        "policy": policy.to_dict(),
        "bytes": sizes,
    }


def _renamed(folder: Path) -> Path:
    """Rename a folder atomically to a trash name that listings ignore, and return the new path."""
    trash = folder.with_name(f"{TRASH}{uuid.uuid4().hex[:8]}-{folder.name}")
    folder.rename(trash)
    fsync_directory(folder.parent)
    return trash


_PAST_AFTER = timedelta(days=7)
"""Minimum age of an empty day folder before its removal.

More recent day folders are kept, because a process possibly creates a run in them at the same time.
"""


def _remove_empty_parents(run: Path) -> None:
    """Remove the robot folder and the day folder of a run if they are empty and old enough."""
    with contextlib.suppress(OSError, ValueError):  # not empty, or not a day folder
        if date.fromisoformat(run.parents[1].name) < date.today() - _PAST_AFTER:
            run.parent.rmdir()
            run.parents[1].rmdir()


def leftovers(runs: Path) -> list[Path]:
    """Return the folders that an interrupted deletion left behind."""
    robots = [robot for day in _without_links(runs) for robot in _without_links(day)]
    places = [*robots, *(run for robot in robots for run in _without_links(robot))]
    return [path for place in places for path in _trash_in(place)]


def _without_links(folder: Path) -> list[Path]:
    """Return the subfolders of a folder that are not symbolic links.

    Links are not followed, so that nothing outside the folder of runs is deleted.
    """
    return [path for path in folders_in(folder) if not path.is_symlink()]


def _trash_in(folder: Path) -> list[Path]:
    try:
        trash = [path for path in folder.iterdir() if path.name.startswith(TRASH)]
    except OSError:
        return []
    return [path for path in trash if not path.is_symlink()]
