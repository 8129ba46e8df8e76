"""All torn recordings of a run directory, and files that belong to one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import DataError, HilError, RecordingError, hold_run, run_holder
from hil.recording.recording_files import PARTIAL_SUFFIX, TORN_SUFFIX, recordings_in, run_of
from hil.recording.recovery import recover_file
from hil.recording.recovery_result import Recovery
from hil.recording.run_directory import RunDirectory, release


@dataclass(frozen=True, slots=True)
class Recoveries:
    """What became of everything that was asked for.

    Attributes:
        source: The run directory or the file.
        files: What became of each file, in order of their names.
        problems: Files that could not be recovered, and why.
    """

    source: Path
    files: tuple[Recovery, ...]
    problems: tuple[tuple[Path, HilError], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        problems = [
            {"file": str(path), "problem": error.message, "hint": error.hint}
            for path, error in self.problems
        ]
        files = [file.to_dict() for file in self.files]
        return {"source": str(self.source), "files": files, "problems": problems}

    @property
    def error(self) -> HilError | None:
        """All problems as one error, None when there is none."""
        if not self.problems:
            return None
        first = self.problems[0][1]
        told = "; ".join(error.message for _, error in self.problems)
        return type(first)(told, hint=first.hint)


def recover(source: Path, out: Path | None = None, *, discard: bool = False) -> Recoveries:
    """Recover a run's torn recordings, or one file; see `recover_file`.

    Args:
        source: A run directory or an MCAP file.
        out: Where the whole file goes; a folder where `source` is a run. Nothing else is touched.
        discard: Delete torn files once what was made of them has been read back; those that an
            earlier recovery set aside, too.

    Raises:
        DataError: The run is live, `source` is neither a run nor an MCAP file, or (for a file)
            there is nothing to rescue in it.
        RecordingError: (For a file) the disk refuses, or the new file reads back different.
    """
    source = Path(source)
    if not source.is_dir():
        belongs_to = run_of(source)
        with _held(belongs_to, writing=out is None) as run:
            one = recover_file(source, out, discard=discard, part=belongs_to is not None)
            _log(run, [one])
        return Recoveries(source, (one,))
    RunDirectory.open(source)
    with _held(source, writing=out is None) as run:
        done, problems = _all_of(source / "recording", out, discard)
        _log(run, done)
        if run is not None:
            release(run)  # a kill left it; an attempt that goes on takes another one
    return Recoveries(source, tuple(done), tuple(problems))


def _all_of(
    folder: Path, out: Path | None, discard: bool
) -> tuple[list[Recovery], list[tuple[Path, HilError]]]:
    files = sorted(folder.glob(f"*.mcap{PARTIAL_SUFFIX}"))
    # A finished one may have lost its end, or be damaged in its middle: all of it is read.
    finished = [
        path
        for path in (recordings_in(folder) if folder.is_dir() else ())
        if path not in files and not _unfinished(path).exists()
    ]
    # What an earlier recovery kept is looked at again only to be deleted.
    kept = sorted(folder.glob(f"*.mcap{TORN_SUFFIX}")) if discard and out is None else []
    done: list[Recovery] = []
    problems: list[tuple[Path, HilError]] = []
    for file in [*files, *finished, *kept]:
        if file in kept and not file.exists():
            continue  # it went with the whole one beside it
        try:
            one = recover_file(file, _inside(out, file), discard=discard, part=True)
        except (DataError, RecordingError) as error:
            problems.append((file, error))
            continue
        if one.did != "nothing" or file not in finished:
            done.append(one)
    return done, problems


def _unfinished(file: Path) -> Path:
    """A recovery that was killed leaves both; the unfinished one is dealt with first."""
    return file.with_name(file.name + PARTIAL_SUFFIX)


def _inside(folder: Path | None, file: Path) -> Path | None:
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot make {folder}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error
    return folder / file.name.removesuffix(PARTIAL_SUFFIX)


@contextlib.contextmanager
def _held(run: Path | None, *, writing: bool) -> Iterator[Path | None]:
    """Keep others from resuming a run meanwhile; a copy made elsewhere leaves it untouched.

    Yields:
        The run where it is written to, else None.
    """
    if run is not None and (holder := run_holder(run)) is not None:
        raise DataError(
            f"{run} is running: its recording is not torn but being written by {holder}",
            hint=f"wait until it is over, or follow it with: hil watch {run}",
        )
    if run is None or not writing:
        yield None
        return
    with hold_run(run):
        yield run


def _log(run: Path | None, done: Sequence[Recovery]) -> None:
    """A run explains itself: what was recovered stands among its events."""
    changed = [file for file in done if file.did != "nothing"]
    if run is None or not changed:
        return
    with RunDirectory(run).event_log() as log:
        for file in changed:
            log.append(
                "recovered",
                file=file.path.name,
                did=file.did,
                problem=file.problem,
                messages=file.salvage.tally.messages,
                lost_bytes=file.lost_bytes,
                damaged_records=file.salvage.damaged,
                orphaned_messages=file.salvage.orphans,
            )
