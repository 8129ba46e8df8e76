"""`hil recover`: converts torn MCAP files into complete, indexed files without losing data.

The new MCAP file is written as a draft, synced to disk, read back with the reader of the mcap
package and compared with the data taken from the torn file. After this comparison, the draft gets
its final name, and then the torn file is renamed to `NN.mcap.torn`. Every renaming is one rename
(or link) followed by an fsync of the directory. The order of the renamings guarantees that a
complete set of data exists at every moment. A kill leaves either the old or the new set of files,
and a repeated recovery continues from there.

The recovery rejects files that another process is writing or recovering, which are locked. The
recovery also rejects live runs. The module `hil.recording.salvage` determines the readable and the
lost data of a torn file.
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Literal

from hil.core import (
    DataError,
    HilError,
    RecordingError,
    fsync_directory,
    hold_run,
    run_holder,
    sha256_of,
)
from hil.recording.mcap_records import Layout, scan
from hil.recording.provenance import version_of
from hil.recording.recording_files import (
    PARTIAL_SUFFIX,
    TORN_SUFFIX,
    hint_of_lost,
    recordings_in,
    run_of,
)
from hil.recording.run_directory import RunDirectory, release
from hil.recording.salvage import (
    Damage,
    Salvage,
    never_got_a_message,
    rebuild,
    survey,
    tally_of,
)

Did = Literal["nothing", "renamed", "rebuilt", "empty", "discarded"]

_MOST_DAMAGES_SHOWN = 5
_LAST_SECOND_OF_9999 = 253402300799.0
_NEVER = (math.inf, -math.inf)


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of the recovery of one MCAP file.

    Attributes:
        path: Path of the file, as passed by the caller.
        did: Action taken: `nothing`, because the file is complete; `renamed`, because only the
            final file name was missing; `rebuilt`; `empty`, also rebuilt, but the file never
            contained a message; or `discarded`, because the file had already been rebuilt.
        out: Path of the complete file after the recovery.
        torn: Present path of the torn file; None if the torn file no longer exists.
        problem: Position and cause of the damage; empty if the file was complete.
        lost_bytes: Number of bytes from the tear to the end of the file.
        salvage: Amounts of recovered data, and descriptions of damage before the tear.
    """

    path: Path
    did: Did
    out: Path
    torn: Path | None = None
    problem: str = ""
    lost_bytes: int = 0
    salvage: Salvage = field(default_factory=Salvage)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON data; times are Unix times [s]."""
        return {
            "file": str(self.path),
            "did": self.did,
            "out": str(self.out),
            "torn": str(self.torn) if self.torn else None,
            "problem": self.problem,
            "lost_bytes": self.lost_bytes,
            "kept": [kept.to_dict() for kept in _kept_by_topic(self.salvage)],
            "damaged": [
                {
                    "at_byte": damage.offset,
                    "bytes": damage.length,
                    "what": damage.what,
                    "from": damage.first_ns * 1e-9 or None,
                    "to": damage.last_ns * 1e-9 or None,
                }
                for damage in self.salvage.damages
            ],
            "damaged_records": self.salvage.damaged,
            "orphaned_messages": self.salvage.orphans,
            "wrong_indexes": self.salvage.misindexed,
        }

    def to_lines(self) -> list[str]:
        """Return the result of the recovery as readable text lines."""
        kept = _kept_by_topic(self.salvage)
        if self.did == "nothing" and self.path != self.out:
            return [f"{self.path} was recovered before: {self.out} contains its messages"]
        if self.did == "nothing":
            counts = ", ".join(f"{one.messages} messages of {one.topic}" for one in kept)
            return [f"{self.path} is undamaged: {counts}"]
        if self.did == "renamed":
            return [f"{self.path} is undamaged, renamed to {self.out}"]
        if self.did == "discarded":
            return [f"{self.path} is deleted: {self.out} contains its messages"]
        lines = [f"{self.path} is {self.problem}"]
        if self.did == "empty":
            lost = "nothing: the process was killed before it wrote samples"
            return [*lines, f"  lost  {lost}", f"  → {self.out}, an empty recording"]
        lines += [f"  kept  {one.to_line()}" for one in kept]
        lines += [f"  lost  {line}" for line in self._lost()]
        aside = f"; the torn file is {self.torn}" if self.torn else "; the torn file is deleted"
        return [*lines, f"  → {self.out}, verified by reading it back{aside}"]

    def _lost(self) -> list[str]:
        found = self.salvage
        lines = [f"{self.lost_bytes} bytes after the tear"] if self.lost_bytes else []
        if lines and found.ended:
            lines = [f"no message: the tear is in the index ({self.lost_bytes} bytes)"]
        lines += [_damage_text(damage) for damage in found.damages[:_MOST_DAMAGES_SHOWN]]
        if (more := found.damaged - _MOST_DAMAGES_SHOWN) > 0:
            lines.append(f"… and {more} more damaged records")
        if found.orphans:
            lines.append(f"{found.orphans} messages without a channel definition")
        if found.misindexed:
            lines.append(f"no message: {found.misindexed} wrong message indexes were rebuilt")
        return lines or ["nothing"]


@dataclass(frozen=True, slots=True)
class Recoveries:
    """Results of the recovery of a run or of one file.

    Attributes:
        source: Path of the run directory or of the file.
        files: Results of the recovered files, sorted by file name.
        problems: Files that could not be recovered, each with its error.
    """

    source: Path
    files: tuple[Recovery, ...]
    problems: tuple[tuple[Path, HilError], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the results of all files as JSON data."""
        problems = [
            {"file": str(path), "problem": error.message, "hint": error.hint}
            for path, error in self.problems
        ]
        files = [file.to_dict() for file in self.files]
        return {"source": str(self.source), "files": files, "problems": problems}

    @property
    def error(self) -> HilError | None:
        """All problems merged into one error; None if all files were recovered."""
        if not self.problems:
            return None
        first = self.problems[0][1]
        message = "; ".join(error.message for _, error in self.problems)
        return type(first)(message, hint=first.hint)


def recover(source: Path, out: Path | None = None, *, discard: bool = False) -> Recoveries:
    """Recover the torn recordings of a run, or one torn file; see `recover_file`.

    Args:
        source: Path of a run directory or of an MCAP file.
        out: Destination of the complete file, or a folder if `source` is a run. If `out` is set,
            all other files stay unchanged.
        discard: Whether to delete torn files after the rebuilt files have been verified. Torn files
            that an earlier recovery renamed are deleted as well if `discard` is true.

    Raises:
        DataError: The run is live, `source` is neither a run nor an MCAP file, or (for a single
            file) no data can be recovered.
        RecordingError: (For a single file) writing failed, or the new file differs when read back.
    """
    source = Path(source)
    if not source.is_dir():
        belongs_to = run_of(source)
        with _run_held(belongs_to, writing=out is None) as run:
            one = recover_file(source, out, discard=discard, part=belongs_to is not None)
            _log(run, [one])
        return Recoveries(source, (one,))
    RunDirectory.open(source)
    with _run_held(source, writing=out is None) as run:
        done, problems = _recover_all(source / "recording", out, discard)
        _log(run, done)
        if run is not None:
            release(run)  # left by a kill; a resumed attempt reserves disk space again
    return Recoveries(source, tuple(done), tuple(problems))


def recover_file(
    path: Path, out: Path | None = None, *, discard: bool = False, part: bool = False
) -> Recovery:
    """Rebuild a torn or damaged MCAP file as a complete file.

    Args:
        path: Path of the MCAP file, which can come from any writer.
        out: Path of the complete file; if `out` is set, all other files stay unchanged. By default,
            the complete file gets the final name of the recording, and the torn file stays next to
            it with the suffix `.torn`.
        discard: Whether to delete the torn file after the rebuilt file has been verified.
        part: Whether the file is one part of the recording of a run. If the writer of a part was
            killed before its first message, the part becomes an empty recording.

    Returns:
        Result of the recovery, including the recovered and the lost data. A file that is already
        complete stays unchanged, and the result states this.

    Raises:
        DataError: The file is missing, is not an MCAP file, contains no complete message, or is
            being written or recovered; or a file with the final name exists and has different
            content.
        RecordingError: Writing failed, or the rebuilt file differs when read back. The torn file is
            unchanged if one of these errors is raised.
    """
    if out is not None and out.exists():
        raise DataError(
            f"{out} exists already, and recordings are never replaced",
            hint="choose a different name: -o FILE",
        )
    names = _Names.of(Path(path), out)
    with _locked_file(names.source) as file:
        layout = scan(file, names.source, places=False)
        names.remove_drafts()
        if names.final != names.source and names.final.exists():
            return _finish_earlier_recovery(file, names, layout, discard)
        whole = _whole(file, names, layout) if layout.complete else None
        if whole is None:
            return _rebuilt(file, names, layout, discard, part)
    if discard and names.kept is not None and names.kept.exists():
        # An earlier recovery was killed before it deleted the torn file.
        return recover_file(names.kept, discard=True, part=part)
    return whole


# Recovery of one file.


def _finish_earlier_recovery(
    file: IO[bytes], names: _Names, layout: Layout, discard: bool
) -> Recovery:
    """Rename the torn file if a killed recovery has already written the complete file."""
    names.require_room()
    salvage = survey(file, names.source, layout)
    try:
        difference = tally_of(names.final).difference(salvage.tally)
    except RecordingError as error:
        difference = error.message
    if difference:
        raise DataError(
            f"{names.final} exists beside {names.source} with different content: {difference}",
            hint="move one of the two files away, or choose a different name: -o FILE",
        )
    torn = names.set_aside(discard)
    did: Did = "nothing" if torn == names.source else "rebuilt" if torn else "discarded"
    return Recovery(names.source, did, names.final, torn, *_lost(layout, salvage), salvage)


def _whole(file: IO[bytes], names: _Names, layout: Layout) -> Recovery | None:
    """Give an undamaged complete file its final name.

    Returns:
        The result of the recovery; None if the file is damaged and must be rebuilt.
    """
    salvage = survey(file, names.source, layout)
    counted = layout.counts is None or sum(layout.counts.values()) == salvage.tally.messages
    if layout.spoilt or salvage.damaged or salvage.orphans or salvage.misindexed or not counted:
        return None
    if names.kept is None or names.source == names.final:
        return Recovery(names.source, "nothing", names.source, salvage=salvage)
    with names.refusal_named():
        os.fsync(file.fileno())  # its writer possibly exited before the fsync
        names.source.rename(names.final)
        fsync_directory(names.final.parent)
    return Recovery(names.source, "renamed", names.final, salvage=salvage)


def _rebuilt(file: IO[bytes], names: _Names, layout: Layout, discard: bool, part: bool) -> Recovery:
    names.require_room()
    draft = names.final.with_name(f".{names.final.name}.{os.getpid()}.draft")
    try:
        with names.refusal_named():
            salvage = _write_draft(file, names, layout, draft, part)
        with draft.open("rb") as written:
            problem = scan(written, draft, places=False).problem
        if problem or (problem := tally_of(draft).difference(salvage.tally)):
            raise RecordingError(
                f"{names.final} differs from the written data when read back: {problem}",
                hint="the disk is possibly failing: recover to a different disk with -o FILE; "
                f"{names.source} is unchanged",
            )
        with names.refusal_named():
            names.install(draft)
    finally:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
    torn = names.source if names.kept is None else names.set_aside(discard)
    did: Did = "rebuilt" if salvage.tally.messages else "empty"
    return Recovery(names.source, did, names.final, torn, *_lost(layout, salvage), salvage)


def _write_draft(
    file: IO[bytes], names: _Names, layout: Layout, draft: Path, part: bool
) -> Salvage:
    note = {
        "from": names.source.name,
        "from_sha256": sha256_of(names.source),
        "from_bytes": str(layout.size),
        "whole_bytes": str(layout.good_bytes),
        "problem": layout.problem,
        "recovered": datetime.now(UTC).isoformat(timespec="seconds"),
        "hil": version_of("hil") or "",
    }
    with draft.open("xb") as out:
        salvage = rebuild(file, names.source, layout, out, note)
        empty = part and never_got_a_message(file, layout, salvage)
        if not salvage.tally.messages and not empty:
            raise _nothing_recoverable(names.source, layout, salvage)
        out.flush()
        os.fsync(out.fileno())
        # The comparison must read the data from the disk, not from the page cache of the kernel.
        os.posix_fadvise(out.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return salvage


def _nothing_recoverable(source: Path, layout: Layout, salvage: Salvage) -> DataError:
    reasons = [layout.problem] if layout.problem else []
    if salvage.damaged:
        reasons.append(f"{salvage.damaged} damaged records, the first {salvage.damages[0].what}")
    if salvage.orphans:
        reasons.append(f"{salvage.orphans} messages without a channel definition")
    return DataError(
        f"{source} contains no message that can be recovered"
        + (f" ({'; '.join(reasons)})" if reasons else ""),
        hint=hint_of_lost(source),
    )


def _lost(layout: Layout, salvage: Salvage) -> tuple[str, int]:
    """Return the description of the damage and the number of bytes after the tear."""
    if not layout.complete:
        return layout.problem, layout.size - layout.good_bytes
    if salvage.damages:
        first = salvage.damages[0]
        return f"damaged: {first.what} at byte {first.offset}", 0
    return layout.problem or "damaged: its index does not point to its messages", 0


@contextlib.contextmanager
def _locked_file(path: Path) -> Iterator[IO[bytes]]:
    """Open and lock the torn file, so that no other process writes or recovers the file.

    Raises:
        DataError: The file cannot be read, or another process writes or recovers it.
    """
    busy = DataError(
        f"{path} is being written or recovered by another process",
        hint="wait until that process has ended; an active recording needs no recovery",
    )
    try:
        with path.open("rb") as file:
            try:
                fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise busy from None
            except OSError:
                pass  # the file system does not support locks
            if not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                raise busy  # the previous lock holder has renamed the file
            yield file
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="check that the file exists and is readable",
        ) from error


@dataclass(frozen=True, slots=True)
class _Names:
    """File names used by one recovery, and the renames between these names.

    The new file gets its final name before the torn file is renamed.

    Attributes:
        source: Path of the torn file.
        final: Path of the complete file.
        kept: Path to which the torn file is moved; None if it is not moved.
    """

    source: Path
    final: Path
    kept: Path | None

    @classmethod
    def of(cls, path: Path, out: Path | None) -> _Names:
        """Return the file names derived from the torn file and, if `out` is set, from `out`."""
        if out is not None:
            return cls(path, out, None)
        for suffix in (PARTIAL_SUFFIX, TORN_SUFFIX):
            if path.name.endswith(suffix):
                final = path.with_name(path.name.removesuffix(suffix))
                return cls(path, final, final.with_name(final.name + TORN_SUFFIX))
        return cls(path, path, path.with_name(path.name + TORN_SUFFIX))

    def require_room(self) -> None:
        """Raise `DataError` if the torn file would replace an existing file."""
        kept = self.kept
        if kept is None or kept == self.source or not kept.exists():
            return
        if self.source == self.final and kept.samefile(self.source):
            return
        raise DataError(
            f"{kept} exists already, and a torn file is never replaced",
            hint="move it away, or choose a different name: -o FILE",
        )

    def remove_drafts(self) -> None:
        """Remove the drafts of killed recoveries.

        No other process can have a draft, because the caller has locked the torn file.
        """
        for draft in self.final.parent.glob(f".{glob.escape(self.final.name)}.*.draft"):
            with contextlib.suppress(OSError):
                draft.unlink()

    def install(self, draft: Path) -> None:
        """Rename a finished draft to the final name of the complete file.

        Raises `OSError`.
        """
        if self.source == self.final and self.kept is not None:
            # First link the torn file under its second name, then replace the final name by the new
            # file, so that the final name exists at every moment.
            if not self.kept.exists():
                os.link(self.source, self.kept)
                fsync_directory(self.final.parent)
            draft.replace(self.final)
        else:
            draft.rename(self.final)
        fsync_directory(self.final.parent)

    def set_aside(self, discard: bool) -> Path | None:
        """Rename or delete the torn file; return its new path, or None after deletion."""
        assert self.kept is not None
        torn = self.kept if self.source == self.final else self.source
        with self.refusal_named():
            if discard:
                torn.unlink()
            elif torn != self.kept:
                torn.rename(self.kept)
            fsync_directory(self.final.parent)
        return None if discard else self.kept

    @contextlib.contextmanager
    def refusal_named(self) -> Iterator[None]:
        """Convert an `OSError` raised in the block into a `RecordingError`."""
        try:
            yield
        except OSError as error:
            raise RecordingError(
                f"cannot recover {self.source} to {self.final}: {error.strerror or error}",
                hint="free space on the disk, or recover to a different disk with -o FILE; "
                "the torn file is unchanged",
            ) from error


# Recovery of a run.


def _recover_all(
    folder: Path, out: Path | None, discard: bool
) -> tuple[list[Recovery], list[tuple[Path, HilError]]]:
    unfinished = sorted(folder.glob(f"*.mcap{PARTIAL_SUFFIX}"))
    # Finished files are read completely, because their end can be missing or their middle damaged.
    # If a killed recovery left both a finished and an unfinished file, the unfinished one is used.
    finished = [
        path
        for path in (recordings_in(folder) if folder.is_dir() else ())
        if path not in unfinished and not path.with_name(path.name + PARTIAL_SUFFIX).exists()
    ]
    # Torn files of an earlier recovery are processed again only to be deleted.
    kept = sorted(folder.glob(f"*.mcap{TORN_SUFFIX}")) if discard and out is None else []
    done: list[Recovery] = []
    problems: list[tuple[Path, HilError]] = []
    for file in [*unfinished, *finished, *kept]:
        if file in kept and not file.exists():
            continue  # deleted together with the complete file next to it
        try:
            into = None if out is None else _made(out) / file.name.removesuffix(PARTIAL_SUFFIX)
            one = recover_file(file, into, discard=discard, part=True)
        except (DataError, RecordingError) as error:
            problems.append((file, error))
            continue
        if one.did != "nothing" or file not in finished:
            done.append(one)
    return done, problems


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot create {folder}: {error.strerror or error}",
            hint="check that the folder is writable and that the disk has free space",
        ) from error
    return folder


@contextlib.contextmanager
def _run_held(run: Path | None, *, writing: bool) -> Iterator[Path | None]:
    """Lock a run against resumption during the block if `writing` is true.

    Yields:
        The run if files of the run will be written, otherwise None.
    """
    if run is not None and (holder := run_holder(run)) is not None:
        raise DataError(
            f"{run} is active: its recording is being written by {holder}",
            hint=f"wait until the run has ended, or follow it with: hil watch {run}",
        )
    if run is None or not writing:
        yield None
        return
    with hold_run(run):
        yield run


def _log(run: Path | None, done: Sequence[Recovery]) -> None:
    """Append the recovered files to the event log of the run."""
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


# Result as text.


@dataclass(frozen=True, slots=True)
class _TopicKept:
    """Recovered messages of one topic, with their time range.

    All times are log times [s, Unix].
    """

    topic: str
    messages: int
    first_s: float
    last_s: float

    def to_dict(self) -> dict[str, Any]:
        """Return the topic as JSON data; times are null if the topic has no message."""
        some = self.messages > 0
        return {
            "topic": self.topic,
            "messages": self.messages,
            "from": self.first_s if some else None,
            "to": self.last_s if some else None,
        }

    def to_line(self) -> str:
        """Return the number and time range of the messages as a readable text line."""
        count = f"{self.messages} messages of {self.topic}"
        return f"{count}, {_span(self.first_s, self.last_s)}" if self.messages else count


def _kept_by_topic(salvage: Salvage) -> list[_TopicKept]:
    """Return the recovered messages per topic, summed over all channels of the topic."""
    out: dict[str, _TopicKept] = {}
    for definition, kept in salvage.tally.channels.items():
        first, last = (kept.first_ns * 1e-9, kept.last_ns * 1e-9) if kept.messages else _NEVER
        one = out.get(definition.topic, _TopicKept(definition.topic, 0, *_NEVER))
        out[definition.topic] = _TopicKept(
            definition.topic,
            one.messages + kept.messages,
            min(one.first_s, first),
            max(one.last_s, last),
        )
    return [out[topic] for topic in sorted(out)]


def _damage_text(damage: Damage) -> str:
    place = f"{damage.what} at byte {damage.offset}, {damage.length} bytes"
    span = _span(damage.first_ns * 1e-9, damage.last_ns * 1e-9)
    return f"{place}, time range in its header {span}" if damage.last_ns else place


def _span(first_s: float, last_s: float) -> str:
    """Return a time range as text, in local time if the times are valid dates."""
    if not 0 < first_s <= last_s < _LAST_SECOND_OF_9999:
        return f"{first_s:.3f} s to {last_s:.3f} s"
    first, last = (datetime.fromtimestamp(t).astimezone() for t in (first_s, last_s))
    ends = f"{last:%H:%M:%S}" if first.date() == last.date() else f"{last:%Y-%m-%d %H:%M:%S}"
    return f"{first:%Y-%m-%d %H:%M:%S} to {ends} ({last_s - first_s:.1f} s)"
