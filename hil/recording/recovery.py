"""`hil recover`: torn MCAP files become whole, indexed ones, without risk to what is there.

The new file is written as a draft, made durable, read back with mcap's own reader and compared
with what was taken from the torn one; only then is it given its name, and only after that is the
torn file set aside as `NN.mcap.torn`. Every change of a name is one rename (or link) followed by an
fsync of the directory, in an order in which no moment is without a complete set of data. A kill at
any point leaves the old state or the new one, and doing it again goes on from there.

A file that is being written or recovered is locked, and so refused; so is a run that is live. What
is whole in a torn file, and what is lost, is found in `hil.recording.salvage`.
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
    """The result for one file.

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
        """Return the JSON form; times are Unix time [s]."""
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
        """Return the same in words, for people."""
        kept = _kept_by_topic(self.salvage)
        if self.did == "nothing" and self.path != self.out:
            return [f"{self.path} was recovered before: {self.out} holds all that is whole in it"]
        if self.did == "nothing":
            counts = ", ".join(f"{one.messages} messages of {one.topic}" for one in kept)
            return [f"{self.path} is whole: {counts}"]
        if self.did == "renamed":
            return [f"{self.path} is whole, only its name was not: it is {self.out} now"]
        if self.did == "discarded":
            return [f"{self.path} is deleted: {self.out} holds all that is whole in it"]
        lines = [f"{self.path} is {self.problem}"]
        if self.did == "empty":
            lost = "nothing: the kill came before its first samples reached it"
            return [*lines, f"  lost  {lost}", f"  → {self.out}, an empty recording"]
        lines += [f"  kept  {one.to_line()}" for one in kept]
        lines += [f"  lost  {line}" for line in self._lost()]
        aside = f"; the torn file is {self.torn}" if self.torn else "; the torn file is deleted"
        return [*lines, f"  → {self.out}, read back and equal{aside}"]

    def _lost(self) -> list[str]:
        found = self.salvage
        lines = [f"{self.lost_bytes} bytes behind the tear"] if self.lost_bytes else []
        if lines and found.ended:
            lines = [f"no message: the tear is in the index ({self.lost_bytes} bytes)"]
        lines += [_damage_in_words(damage) for damage in found.damages[:_MOST_DAMAGES_SHOWN]]
        if (more := found.damaged - _MOST_DAMAGES_SHOWN) > 0:
            lines.append(f"… and {more} more damaged records")
        if found.orphans:
            lines.append(f"{found.orphans} messages of which nothing says what they are")
        if found.misindexed:
            lines.append(f"nothing by {found.misindexed} wrong message indexes: they are made anew")
        return lines or ["nothing"]


@dataclass(frozen=True, slots=True)
class Recoveries:
    """The results for a run, or for one file.

    Attributes:
        source: The run directory or the file.
        files: The result for each file, in order of their names.
        problems: Files that could not be recovered, and why.
    """

    source: Path
    files: tuple[Recovery, ...]
    problems: tuple[tuple[Path, HilError], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
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
        message = "; ".join(error.message for _, error in self.problems)
        return type(first)(message, hint=first.hint)


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
        with _run_held(belongs_to, writing=out is None) as run:
            one = recover_file(source, out, discard=discard, part=belongs_to is not None)
            _log(run, [one])
        return Recoveries(source, (one,))
    RunDirectory.open(source)
    with _run_held(source, writing=out is None) as run:
        done, problems = _recover_all(source / "recording", out, discard)
        _log(run, done)
        if run is not None:
            release(run)  # a kill left it; an attempt that goes on takes another one
    return Recoveries(source, tuple(done), tuple(problems))


def recover_file(
    path: Path, out: Path | None = None, *, discard: bool = False, part: bool = False
) -> Recovery:
    """Make a torn or damaged MCAP file whole.

    Args:
        path: The file, of this package or any other writer.
        out: Where the whole file goes; nothing else is touched then. By default the whole file
            takes the final name, and the torn one is kept beside it with `.torn` behind its name.
        discard: Delete the torn file once what was made of it has been read back.
        part: It is part of a run: a kill before its first message leaves an empty recording, and
            that is what it becomes.

    Returns:
        What was kept and lost. A file that is whole is left as it is.

    Raises:
        DataError: It is missing or no MCAP file, not one message in it is whole, it is being
            written or recovered, or a file of the final name is there and holds something else.
        RecordingError: The disk refuses, or what was written reads back different. The torn file
            is as it was then.
    """
    if out is not None and out.exists():
        raise DataError(
            f"{out} exists already, and no recording is replaced", hint="give another name: -o FILE"
        )
    names = _Names.of(Path(path), out)
    with _file_held(names.source) as file:
        layout = scan(file, names.source, places=False)
        names.remove_drafts()
        if names.final != names.source and names.final.exists():
            return _finish_an_older_one(file, names, layout, discard)
        whole = _whole(file, names, layout) if layout.complete else None
        if whole is None:
            return _rebuilt(file, names, layout, discard, part)
    if discard and names.kept is not None and names.kept.exists():
        # A kill came before it was deleted.
        return recover_file(names.kept, discard=True, part=part)
    return whole


# One file.


def _finish_an_older_one(file: IO[bytes], names: _Names, layout: Layout, discard: bool) -> Recovery:
    """Set the torn file aside: the whole one is there, so a kill came before that was done."""
    names.require_room()
    salvage = survey(file, names.source, layout)
    try:
        difference = tally_of(names.final).difference(salvage.tally)
    except RecordingError as error:
        difference = error.message
    if difference:
        raise DataError(
            f"{names.final} is there beside {names.source} and holds something else: {difference}",
            hint="move one of the two away, or give another name: -o FILE",
        )
    torn = names.set_aside(discard)
    did: Did = "nothing" if torn == names.source else "rebuilt" if torn else "discarded"
    return Recovery(names.source, did, names.final, torn, *_lost(layout, salvage), salvage)


def _whole(file: IO[bytes], names: _Names, layout: Layout) -> Recovery | None:
    """Give a file that has its end its final name if all of it is right; None if it is not."""
    salvage = survey(file, names.source, layout)
    counted = layout.counts is None or sum(layout.counts.values()) == salvage.tally.messages
    if layout.spoilt or salvage.damaged or salvage.orphans or salvage.misindexed or not counted:
        return None
    if names.kept is None or names.source == names.final:
        return Recovery(names.source, "nothing", names.source, salvage=salvage)
    with names.refusal_named():
        os.fsync(file.fileno())  # its writer may have died before it did that
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
                f"what was written for {names.final} reads back different: {problem}",
                hint="the disk may be failing: recover to another one with -o FILE; "
                f"{names.source} is as it was",
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
            raise _nothing_to_rescue(names.source, layout, salvage)
        out.flush()
        os.fsync(out.fileno())
        # What is compared shall come from the disk, not from the kernel's memory.
        os.posix_fadvise(out.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return salvage


def _nothing_to_rescue(source: Path, layout: Layout, salvage: Salvage) -> DataError:
    reasons = [layout.problem] if layout.problem else []
    if salvage.damaged:
        reasons.append(f"{salvage.damaged} damaged records, the first {salvage.damages[0].what}")
    if salvage.orphans:
        reasons.append(f"{salvage.orphans} messages of which nothing says what they are")
    return DataError(
        f"there is nothing to rescue in {source}: no message in it is whole"
        + (f" ({'; '.join(reasons)})" if reasons else ""),
        hint=hint_of_lost(source),
    )


def _lost(layout: Layout, salvage: Salvage) -> tuple[str, int]:
    """Return what was wrong with a file, and how much of it lies behind the tear [bytes]."""
    if not layout.complete:
        return layout.problem, layout.size - layout.good_bytes
    if salvage.damages:
        first = salvage.damages[0]
        return f"damaged: {first.what} at byte {first.offset}", 0
    return layout.problem or "damaged: its index leads elsewhere than to its messages", 0


@contextlib.contextmanager
def _file_held(path: Path) -> Iterator[IO[bytes]]:
    """Open the torn file, for this process alone as far as writing and recovering go.

    Raises:
        DataError: It cannot be read, or is being written or recovered.
    """
    busy = DataError(
        f"{path} is not torn: it is being written, or recovered, at this moment",
        hint="wait until that is over; a recording that still goes on needs no recovery",
    )
    try:
        with path.open("rb") as file:
            try:
                fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise busy from None
            except OSError:
                pass  # a file system without locks
            if not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                raise busy  # its holder of a moment ago has given it another name
            yield file
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="see whether it exists and may be read",
        ) from error


@dataclass(frozen=True, slots=True)
class _Names:
    """Names of the files of one recovery, and how they change hands.

    The new file gets its name before the torn one loses its own.

    Attributes:
        source: The torn file.
        final: The whole one.
        kept: Where the torn file goes; None when it stays where it is.
    """

    source: Path
    final: Path
    kept: Path | None

    @classmethod
    def of(cls, path: Path, out: Path | None) -> _Names:
        """Return the names by those of the torn file and, if it has one, of the whole one."""
        if out is not None:
            return cls(path, out, None)
        for suffix in (PARTIAL_SUFFIX, TORN_SUFFIX):
            if path.name.endswith(suffix):
                final = path.with_name(path.name.removesuffix(suffix))
                return cls(path, final, final.with_name(final.name + TORN_SUFFIX))
        return cls(path, path, path.with_name(path.name + TORN_SUFFIX))

    def require_room(self) -> None:
        """Refuse if the torn file would take the name of another. Raises `DataError`."""
        kept = self.kept
        if kept is None or kept == self.source or not kept.exists():
            return
        if self.source == self.final and kept.samefile(self.source):
            return
        raise DataError(
            f"{kept} exists already, and a torn file is never replaced",
            hint="move it away, or give another name: -o FILE",
        )

    def remove_drafts(self) -> None:
        """Remove drafts of recoveries that were killed: the torn file's holder has no others."""
        for draft in self.final.parent.glob(f".{glob.escape(self.final.name)}.*.draft"):
            with contextlib.suppress(OSError):
                draft.unlink()

    def install(self, draft: Path) -> None:
        """Give a finished draft its name. Raises `OSError`."""
        if self.source == self.final and self.kept is not None:
            # Both names for the torn file, then the final one for the new: it is never missing.
            if not self.kept.exists():
                os.link(self.source, self.kept)
                fsync_directory(self.final.parent)
            draft.replace(self.final)
        else:
            draft.rename(self.final)
        fsync_directory(self.final.parent)

    def set_aside(self, discard: bool) -> Path | None:
        """Give the torn file its last name, or delete it; return where it is."""
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
        """Raise what the disk refuses inside as a `RecordingError`."""
        try:
            yield
        except OSError as error:
            raise RecordingError(
                f"cannot recover {self.source} to {self.final}: {error.strerror or error}",
                hint="mend or free the disk, or recover to another one with -o FILE; "
                "the torn file is as it was",
            ) from error


# A run.


def _recover_all(
    folder: Path, out: Path | None, discard: bool
) -> tuple[list[Recovery], list[tuple[Path, HilError]]]:
    unfinished = sorted(folder.glob(f"*.mcap{PARTIAL_SUFFIX}"))
    # A finished one may have lost its end, or be damaged in its middle: all of it is read. Where a
    # recovery that was killed left both, the unfinished one is dealt with.
    finished = [
        path
        for path in (recordings_in(folder) if folder.is_dir() else ())
        if path not in unfinished and not path.with_name(path.name + PARTIAL_SUFFIX).exists()
    ]
    # What an earlier recovery kept is looked at again only to be deleted.
    kept = sorted(folder.glob(f"*.mcap{TORN_SUFFIX}")) if discard and out is None else []
    done: list[Recovery] = []
    problems: list[tuple[Path, HilError]] = []
    for file in [*unfinished, *finished, *kept]:
        if file in kept and not file.exists():
            continue  # it went with the whole one beside it
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
            f"cannot make {folder}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error
    return folder


@contextlib.contextmanager
def _run_held(run: Path | None, *, writing: bool) -> Iterator[Path | None]:
    """Keep others from resuming a run meanwhile; a copy made elsewhere leaves it untouched.

    Yields:
        The run if it is written to, else None.
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
    """Log what was recovered among the events of the run: a run explains itself."""
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


# The result in words.


@dataclass(frozen=True, slots=True)
class _TopicKept:
    """What was kept of one topic; times are log times [s, Unix]."""

    topic: str
    messages: int
    first_s: float
    last_s: float

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form; times are null where there is no message."""
        some = self.messages > 0
        return {
            "topic": self.topic,
            "messages": self.messages,
            "from": self.first_s if some else None,
            "to": self.last_s if some else None,
        }

    def to_line(self) -> str:
        """Return it in words."""
        count = f"{self.messages} messages of {self.topic}"
        return f"{count}, {_span(self.first_s, self.last_s)}" if self.messages else count


def _kept_by_topic(salvage: Salvage) -> list[_TopicKept]:
    """Return what was kept by topic, channels of the same one added up."""
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


def _damage_in_words(damage: Damage) -> str:
    place = f"{damage.what} at byte {damage.offset}, {damage.length} bytes"
    span = _span(damage.first_ns * 1e-9, damage.last_ns * 1e-9)
    return f"{place}, by its head {span}" if damage.last_ns else place


def _span(first_s: float, last_s: float) -> str:
    """Return from when to when, in local time if it can be one."""
    if not 0 < first_s <= last_s < _LAST_SECOND_OF_9999:
        return f"{first_s:.3f} s to {last_s:.3f} s"
    first, last = (datetime.fromtimestamp(t).astimezone() for t in (first_s, last_s))
    ends = f"{last:%H:%M:%S}" if first.date() == last.date() else f"{last:%Y-%m-%d %H:%M:%S}"
    return f"{first:%Y-%m-%d %H:%M:%S} to {ends} ({last_s - first_s:.1f} s)"
