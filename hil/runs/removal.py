"""Deleting runs so that a kill leaves none that looks whole: renamed first, removed then."""

from __future__ import annotations

import contextlib
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from datetime import date, timedelta
from pathlib import Path
from typing import Any

from hil.core import DataError, RecordingError, fsync_directory, hold_run
from hil.recording import PRUNED, RunDirectory, folders_in, operator, utc_now
from hil.runs.facts import facts_of
from hil.runs.origins import origins
from hil.runs.retention import Decision, Policy, guard, why_link

TRASH = ".trash-"
"""Beginning of what was renamed and is on its way out; no run begins with a dot."""

_TIDY_AFTER = timedelta(days=7)
"""Folders of a day in which a run may begin yet are left alone."""


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


def _remove(run: Path, policy: Policy, registries: list[Path]) -> str:
    """Delete a run; or why it stays after all."""
    if why := why_link(run, policy):
        return why
    with _refused(run, "nothing of it is deleted yet"):
        try:
            with hold_run(run):
                # Held by us it counts as live; whoever held it before has let it go.
                facts = facts_of(run) | {"status": RunDirectory.open(run).status}
                if why := guard(run, facts, origins(registries), policy):
                    return why
                gone = _take_recordings(run, policy) if policy.recordings_only else _take(run)
        except DataError as error:
            return error.message
    with _refused(gone, "what is left of it counts no more and goes with the next hil prune --yes"):
        shutil.rmtree(gone)
    if not policy.recordings_only:
        _tidy(run)
    return ""


def _take(folder: Path) -> Path:
    """Rename a folder to what no longer counts; in one step, and for good."""
    gone = folder.with_name(f"{TRASH}{uuid.uuid4().hex[:8]}-{folder.name}")
    folder.rename(gone)
    fsync_directory(folder.parent)
    return gone


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


def _tidy(run: Path) -> None:
    """Remove the folders of the robot and the day once they are empty and long past."""
    with contextlib.suppress(OSError, ValueError):
        if date.fromisoformat(run.parents[1].name) < date.today() - _TIDY_AFTER:
            run.parent.rmdir()
            run.parents[1].rmdir()


@contextlib.contextmanager
def _refused(folder: Path, state: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot delete {folder}: {error.strerror or error}",
            hint=f"see whether it may be written to; {state}",
        ) from error
