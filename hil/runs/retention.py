"""Retention of runs: which ones a policy deletes, why the others stay, and their removal.

`decide` deletes nothing. It returns a decision per run with the reason for keeping it, from the
strongest to the weakest: a link leads to it; it is live, damaged, interrupted, or a model was
fitted to it (`hil.runs.origins`); the policy keeps it; it belongs to a series or fleet of which
another run has to stay, as the runs of a group say something only together.

`remove` checks each run again just before it deletes it, and deletes so that a kill leaves no run
that looks whole: the run is renamed in one step to a name that no longer counts, and removed then.
What a killed deletion has left (`leftovers`), the next one removes.
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
    """Which runs may be deleted: those that meet all of it.

    Attributes:
        terms: Of a query (`hil.runs.query`): only runs that meet them.
        older: Only runs that were started longer ago than this.
        keep: Only runs after which so many of the same robot and experiment were measured in full.
        interrupted: Also runs that were interrupted.
        recordings_only: Delete recordings; documents, models and reports stay.
        typed: `older` as it was typed; empty if it was not.
    """

    terms: tuple[str, ...] = ()
    older: timedelta | None = None
    keep: int | None = None
    interrupted: bool = False
    recordings_only: bool = False
    typed: str = ""

    @property
    def age(self) -> str:
        """`older` in words; empty without it."""
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
    """Whether one run is deleted.

    Attributes:
        run: Its directory.
        why: Why it stays; empty if it goes.
        guarded: It stays whatever the policy says.
        size: Of what would be deleted [bytes].
    """

    run: Path
    why: str = ""
    guarded: bool = False
    size: int = 0

    @property
    def goes(self) -> bool:
        """Whether it is deleted: the policy allows it, and nothing else speaks against it."""
        return not self.why

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"run": str(self.run), "goes": self.goes, "why": self.why, "bytes": self.size}


def decide(
    runs: Path, policy: Policy, registries: Iterable[Path], now: float | None = None
) -> list[Decision]:
    """Return what a policy decides about each run of its query, the lowest number first.

    Args:
        runs: The folder of runs.
        policy: What may go.
        registries: Folders of models; each must be there.
        now: For ages [s, Unix]; by default the present moment.

    Raises:
        SpecError: The policy would delete every run, or a term cannot be understood.
        RegistryError: A registry cannot be read: then nothing may go.
        DataError: A folder below `runs`, or the document of a series or of a run, cannot be read.
    """
    if policy.older is None and policy.keep is None:
        raise SpecError(
            "this policy would let every run go",
            hint="say which may: --older-than 180d, --keep 20 (of a robot and experiment), or both",
        )
    _require_readable(runs)
    known = origins(registries)
    queried = {run["run"] for run in find_runs(*policy.terms, runs=runs)}
    # Every run is decided on, whatever the query: one that stays may keep the others of its group.
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
    # Last, and only for runs that would go: all samples are read to recognise a run by its rows.
    names = {path.name for path in run_folders(runs)}
    by_rows = why_by_rows(one for one in known.by_name if one.name not in names)
    for k, one in enumerate(decisions):
        if one.goes and (why := by_rows(one.run)):
            decisions[k] = Decision(one.run, why, guarded=True)
    groups = [*_series(runs), *_fleets(runs, [one.run for one in decisions])]
    return [one for one in _keep_groups(decisions, groups) if str(one.run) in queried]


def _require_readable(runs: Path) -> None:
    """Raise if runs, or groups that keep runs, may lie in folders that cannot be read."""
    refused = unreadable_folders(runs) + SeriesGroup.unreadable(runs) + FleetGroup.unreadable(runs)
    if refused:
        raise DataError(
            "\n".join(f"cannot read {folder}: {why}" for folder, why in refused),
            hint="nothing is deleted before: what lies there may keep other runs; "
            "see whether you may read it",
        )


def _measured_after(entries: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Return, by run, how many of its robot and experiment were measured in full after it.

    Args:
        entries: As of `hil.runs.catalogue.find_runs`.
    """
    count: Counter[tuple[str, str]] = Counter()
    newer: dict[str, int] = {}
    by_identity: dict[str, int] = {}  # a link to a run, or its copy, counts as that run
    for run in sorted(entries, key=lambda one: (started_s(one) or 0.0, one["number"]))[::-1]:
        kind, identity = (run["robot"], run["name"]), run["uid"] or run["run"]
        if identity not in by_identity:
            by_identity[identity] = count[kind]
            count[kind] += _in_full(run)
        newer[run["run"]] = by_identity[identity]
    return newer


def _in_full(facts: Mapping[str, Any]) -> bool:
    """Return whether a run can replace an older one: no commissioning run, and nothing wrong."""
    run = Path(facts["run"])
    good = facts["status"] == "completed" and facts["verdict"] != "rejected"
    return good and bool(RunDirectory(run).recordings) and "commissioning" not in _start_of(run)


def _start_of(run: Path) -> Mapping[str, Any]:
    """Return the start document of a run; empty if it is damaged."""
    try:
        return read_json(run / "start.json")
    except DataError:
        return {}


def _why_link(run: Path, policy: Policy) -> str:
    """Return why a run that is reached by a link stays; empty without a link on the way.

    Its target may lie outside the folder of runs; if it lies inside, it is listed by itself.
    """
    if any(part.is_symlink() for part in (run, *run.parents[:2])):  # DAY/ROBOT/RUN
        return "it is a link"
    if policy.recordings_only and (run / "recording").is_symlink():
        return "its recordings are a link"
    return ""


def _guard(run: Path, facts: Mapping[str, Any], known: Origins, policy: Policy) -> str:
    """Return why a run stays whatever the policy says; empty if it need not stay.

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
    """Return how much would be deleted of a run [bytes]."""
    folder = run / "recording" if policy.recordings_only else run
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())


def _series(runs: Path) -> list[tuple[str, set[Path]]]:
    """Return the name and the runs of each series."""
    groups = []
    for path in filter(SeriesGroup.is_at, SeriesGroup.folders(runs)):
        try:
            members = SeriesGroup.open(path).members()
        except DataError as error:
            hint = "nothing is deleted before; its folder is a view and may be moved away"
            raise DataError(error.message, hint=hint) from error
        groups.append((path.name, {one.run.resolve() for one in members if one.run is not None}))
    return groups


def _fleets(runs: Path, paths: Iterable[Path]) -> list[tuple[str, set[Path]]]:
    """Return the name and the runs of each fleet, by what the runs themselves say."""
    known = {path.parts[-3:] for path in FleetGroup.folders(runs)}  # DAY/fleet/fleet-NAME
    groups: defaultdict[tuple[str, ...], set[Path]] = defaultdict(set)
    for run in paths if known else ():
        if (fleet := FleetGroup.place_named_by(run)) in known:
            groups[fleet].add(run.resolve())
    return [(name, members) for (*_, name), members in groups.items()]


def _keep_groups(decisions: list[Decision], groups: list[tuple[str, set[Path]]]) -> list[Decision]:
    """Return the decisions, with every run of a group guarded of which one run is guarded."""
    guarded = {one.run.resolve(): one for one in decisions if one.guarded}
    reasons: dict[Path, str] = {}
    for name, members in groups:
        for member in members & guarded.keys():
            one = guarded[member]
            reasons |= dict.fromkeys(members, f"it is of {name}, as {one.run.name}: {one.why}")
    return [
        replace(one, why=reasons[path], guarded=True, size=0)
        if not one.guarded and (path := one.run.resolve()) in reasons
        else one
        for one in decisions
    ]


TRASH = ".trash-"
"""Beginning of the names of folders that are being deleted; no run begins with a dot."""


def remove(
    decisions: Iterable[Decision],
    runs: Path,
    policy: Policy,
    registries: Iterable[Path],
    tell: Callable[[Decision], None] = lambda _: None,
) -> list[Decision]:
    """Delete the runs that go, after checking each of them again.

    Args:
        decisions: From `hil.runs.retention.decide`.
        runs: The folder of runs.
        policy: That they were decided by.
        registries: Folders of models, read again for every run.
        tell: Called with every run that is gone.

    Returns:
        The decisions as they turned out: a run that is live by now, or has a model, stays.

    Raises:
        RegistryError: A registry cannot be read.
        RecordingError: The disk refuses.
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
    """Delete a run; return why it stays after all, empty if it is gone."""
    if why := _why_link(run, policy):
        return why
    with _refused(run, "nothing of it is deleted yet"):
        try:
            with hold_run(run):
                # It counts as live while it is held here: its status is asked for apart.
                facts = facts_of(run) | {"status": RunDirectory.open(run).status}
                if why := _guard(run, facts, origins(registries), policy):
                    return why
                if not policy.recordings_only:
                    trash = _renamed(run)
                else:
                    directory = RunDirectory(run)
                    if not (run / PRUNED).exists():  # else a deletion that was killed wrote it
                        directory.write_json(PRUNED, _pruned_document(directory, policy))
                    trash = _renamed(run / "recording")
        except DataError as error:
            return error.message
    with _refused(trash, "the rest of it does not count and goes with the next hil prune --yes"):
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
            hint=f"see whether it may be written to; {state}",
        ) from error


def _pruned_document(directory: RunDirectory, policy: Policy) -> dict[str, Any]:
    """Return what `pruned.json` says of the recordings that are about to be deleted."""
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
    """Rename a folder, in one step and for good, to a name that no longer counts; return it."""
    trash = folder.with_name(f"{TRASH}{uuid.uuid4().hex[:8]}-{folder.name}")
    folder.rename(trash)
    fsync_directory(folder.parent)
    return trash


_PAST_AFTER = timedelta(days=7)
"""Folders of younger days stay, even if empty: a run may still begin in one of them."""


def _remove_empty_parents(run: Path) -> None:
    """Remove the folders of the robot and the day if they are empty and the day is long past."""
    with contextlib.suppress(OSError, ValueError):  # not empty, or no folder of a day
        if date.fromisoformat(run.parents[1].name) < date.today() - _PAST_AFTER:
            run.parent.rmdir()
            run.parents[1].rmdir()


def leftovers(runs: Path) -> list[Path]:
    """Return what a deletion that was killed has left."""
    robots = [robot for day in _without_links(runs) for robot in _without_links(day)]
    places = [*robots, *(run for robot in robots for run in _without_links(robot))]
    return [path for place in places for path in _trash_in(place)]


def _without_links(folder: Path) -> list[Path]:
    """Return the folders in a folder that are no links: nothing outside the runs is deleted."""
    return [path for path in folders_in(folder) if not path.is_symlink()]


def _trash_in(folder: Path) -> list[Path]:
    try:
        trash = [path for path in folder.iterdir() if path.name.startswith(TRASH)]
    except OSError:
        return []
    return [path for path in trash if not path.is_symlink()]
