"""Retention of runs: which ones a policy lets go, why the others stay, and their removal.

`decide` deletes nothing. It returns a decision per run with the reason for keeping it, from the
strongest to the weakest: a link leads to it; it is live, damaged, interrupted, or a model was
fitted to it (`hil.runs.origins`); the policy keeps it; it belongs to a series or fleet of which
another run has to stay, as those say something only together.

`remove` looks once more at each run just before it goes, and deletes so that a kill leaves none
that looks whole: the run is renamed in one step to a name that no longer counts, and removed then.
`leftovers` are what a deletion that was killed has left; the next one removes them.
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
from hil.recording import PRUNED, RunDirectory, folders_in, operator, run_folders, utc_now
from hil.runs.catalogue import find_runs
from hil.runs.listing import facts_of, started_s
from hil.runs.origins import Origins, origins, why_by_rows
from hil.runs.series_folder import SeriesFolder, is_series_folder


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
    # Last, and of what would go only: all samples of a run are read to recognise it by its rows.
    there = {path.name for path in run_folders(runs)}
    by_rows = why_by_rows(one for one in known.by_name if one.name not in there)
    for k, one in enumerate(decisions):
        if one.goes and (why := by_rows(one.run)):
            decisions[k] = Decision(one.run, why, guarded=True)
    groups = [*_series(runs), *_fleets(runs, [one.run for one in decisions])]
    return [one for one in _keep_groups(decisions, groups) if str(one.run) in asked]


def _measured_after(entries: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Run → how many of its robot and experiment were measured in full after it.

    Args:
        entries: As of `hil.runs.catalogue.find_runs`.
    """
    count: Counter[tuple[str, str]] = Counter()
    newer: dict[str, int] = {}
    of_one: dict[str, int] = {}  # a run by a link, and its copy, are no further ones
    for run in sorted(entries, key=lambda one: (started_s(one) or 0.0, one["number"]))[::-1]:
        kind, identity = (run["robot"], run["name"]), run["uid"] or run["run"]
        if identity not in of_one:
            of_one[identity] = count[kind]
            count[kind] += _in_full(run)
        newer[run["run"]] = of_one[identity]
    return newer


def _in_full(facts: Mapping[str, Any]) -> bool:
    """Whether a run can take an older one's place: no rehearsal, and nothing wrong with it."""
    run = Path(facts["run"])
    good = facts["status"] == "completed" and facts["verdict"] != "rejected"
    return good and bool(RunDirectory(run).recordings) and "commissioning" not in _start_of(run)


def _start_of(run: Path) -> Mapping[str, Any]:
    """What a run says of its beginning; nothing if it is damaged."""
    try:
        return read_json(run / "start.json")
    except DataError:
        return {}


def _why_link(run: Path, policy: Policy) -> str:
    """Why a run that is reached over a link stays; empty where none is on the way.

    What a link leads to is no policy's business, and if it lies here it is a run of its own.
    """
    if any(part.is_symlink() for part in (run, *run.parents[:2])):  # DAY/ROBOT/RUN
        return "it is a link"
    if policy.recordings_only and (run / "recording").is_symlink():
        return "its recordings are a link"
    return ""


def _guard(run: Path, facts: Mapping[str, Any], known: Origins, policy: Policy) -> str:
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
    """Bytes that go with a run."""
    folder = run / "recording" if policy.recordings_only else run
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())


def _series(runs: Path) -> list[tuple[str, set[Path]]]:
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


def _fleets(runs: Path, paths: Iterable[Path]) -> list[tuple[str, set[Path]]]:
    """By the specs that runs name: `fleet.json` is behind them after a kill."""
    known = {path.parts[-3:] for day in folders_in(runs) for path in folders_in(day / "fleet")}
    found: defaultdict[tuple[str, ...], set[Path]] = defaultdict(set)
    for run in paths if known else ():
        # DAY/fleet/fleet-NAME/specs/ROBOT.yaml; runs may have been moved together since
        fleet = Path(str(_start_of(run).get("spec", ""))).parts[-5:-2]
        if fleet in known:
            found[fleet].add(run.resolve())
    return [(name, members) for (*_, name), members in found.items()]


def _keep_groups(decisions: list[Decision], groups: list[tuple[str, set[Path]]]) -> list[Decision]:
    """Keep every run of a series or fleet of which one has to stay."""
    guarded = {one.run.resolve(): one for one in decisions if one.guarded}
    kept: dict[Path, str] = {}
    for name, members in groups:
        for member in members & guarded.keys():
            run = guarded[member]
            kept |= dict.fromkeys(members, f"it is of {name}, as {run.run.name}: {run.why}")
    return [
        replace(one, why=kept[path], guarded=True, size=0)
        if not one.guarded and (path := one.run.resolve()) in kept
        else one
        for one in decisions
    ]


TRASH = ".trash-"
"""Beginning of what was renamed and is on its way out; no run begins with a dot."""


def remove(
    decisions: Iterable[Decision],
    runs: Path,
    policy: Policy,
    registries: Iterable[Path],
    tell: Callable[[Decision], None] = lambda _: None,
) -> list[Decision]:
    """Delete what goes, looking once more at each run just before.

    Args:
        decisions: From `hil.runs.retention.decide`.
        runs: The folder of runs.
        policy: As it was decided by.
        registries: Folders of models, read again for every run.
        tell: Told about every run that is gone.

    Returns:
        What became of each; a run that was taken in hand meanwhile stays.

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
    """Delete a run; or why it stays after all."""
    if why := _why_link(run, policy):
        return why
    with _refused(run, "nothing of it is deleted yet"):
        try:
            with hold_run(run):
                # Held by us it counts as live; whoever held it before has let it go.
                facts = facts_of(run) | {"status": RunDirectory.open(run).status}
                if why := _guard(run, facts, origins(registries), policy):
                    return why
                gone = _take_recordings(run, policy) if policy.recordings_only else _take(run)
        except DataError as error:
            return error.message
    with _refused(gone, "what is left of it counts no more and goes with the next hil prune --yes"):
        shutil.rmtree(gone)
    if not policy.recordings_only:
        _tidy(run)
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


def _take_recordings(run: Path, policy: Policy) -> Path:
    """Note in the run what is taken from it, and take it."""
    directory = RunDirectory(run)
    if not (run / PRUNED).exists():  # a deletion that was killed has noted it
        directory.write_json(PRUNED, _note(directory, policy))
    return _take(run / "recording")


def _note(directory: RunDirectory, policy: Policy) -> dict[str, Any]:
    sizes = {
        path.relative_to(directory.path).as_posix(): path.stat().st_size
        for path in sorted((directory.path / "recording").rglob("*"))
        if path.is_file()
    }
    told = {"at": utc_now(), "by": operator(), "policy": policy.to_dict(), "bytes": sizes}
    return {"hil_pruned": 1, **told}


def _take(folder: Path) -> Path:
    """Rename a folder to what no longer counts; in one step, and for good."""
    gone = folder.with_name(f"{TRASH}{uuid.uuid4().hex[:8]}-{folder.name}")
    folder.rename(gone)
    fsync_directory(folder.parent)
    return gone


_TIDY_AFTER = timedelta(days=7)
"""Folders of a day in which a run may begin yet are left alone."""


def _tidy(run: Path) -> None:
    """Remove the folders of the robot and the day once they are empty and long past."""
    with contextlib.suppress(OSError, ValueError):
        if date.fromisoformat(run.parents[1].name) < date.today() - _TIDY_AFTER:
            run.parent.rmdir()
            run.parents[1].rmdir()


def leftovers(runs: Path) -> list[Path]:
    """What a deletion that was killed has left."""
    robots = [robot for day in _own(runs) for robot in _own(day)]
    places = [*robots, *(run for robot in robots for run in _own(robot))]
    return [path for place in places for path in _trash_in(place)]


def _own(folder: Path) -> list[Path]:
    """Folders in a folder, without links: what they lead to is no business of a policy."""
    return [path for path in folders_in(folder) if not path.is_symlink()]


def _trash_in(folder: Path) -> list[Path]:
    try:
        found = [path for path in folder.iterdir() if path.name.startswith(TRASH)]
    except OSError:
        return []
    return [path for path in found if not path.is_symlink()]
