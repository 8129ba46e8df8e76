"""Run by test_record_recover_kill: recovers a copy of a torn file and dies at the n-th step.

Usage: kill_recover.py TORN WORK [--discard]. Prints one JSON line per step it died at. A step is
a file system call of the recovery (open, rename, link, unlink, fsync) or a message written.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from hil.core.errors import HilError
from hil.recording.mcap_reader import read_topic
from hil.recording.recovery import recover_file

STEPS = ("open", "os.rename", "os.link", "os.remove")
KILLED = 77


class Fuse:
    """Ends the process, without any clean-up, when so many steps have been taken."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def burn(self) -> None:
        if self.left == 0:
            os._exit(KILLED)
        self.left -= 1

    def light(self) -> None:
        def counted(real: Any, every: int = 1) -> Any:
            calls = 0

            def call(*args: Any) -> Any:
                nonlocal calls
                if calls % every == 0:
                    self.burn()
                calls += 1
                return real(*args)

            return call

        os.fsync = counted(os.fsync)
        Writer.add_message = counted(Writer.add_message, every=17)  # type: ignore[method-assign]
        sys.addaudithook(lambda event, _: self.burn() if event in STEPS else None)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def state_of(folder: Path) -> dict[str, str]:
    """Name → what it is: whole rows, or the digest of bytes."""
    out = {}
    for path in sorted(folder.iterdir()):
        if path.name.endswith(".draft"):
            continue
        out[path.name] = digest(path)
        with contextlib.suppress(HilError):
            rows = read_topic(path)
            out[path.name] = f"{len(rows)} rows {hashlib.sha256(rows.tobytes()).hexdigest()}"
    return out


def die_at(step: int, torn: Path, discard: bool) -> bool:
    """Recover in a child that dies at this step; false when it came to the end before."""
    child = os.fork()
    if child == 0:
        Fuse(step).light()
        recover_file(torn, discard=discard)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == KILLED


def main() -> None:
    original, work, discard = Path(sys.argv[1]), Path(sys.argv[2]), "--discard" in sys.argv
    step, killed = 0, True
    while killed:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        torn = work / original.name
        shutil.copy(original, torn)
        killed = die_at(step, torn, discard)
        dead = state_of(work)
        again = torn if torn.exists() else work / "00.mcap"
        recover_file(again, discard=discard)
        after = state_of(work)
        drafts = [path.name for path in work.iterdir() if path.name.endswith(".draft")]
        line = {"step": step, "dead": dead, "after": after, "drafts": drafts}
        sys.stdout.write(json.dumps(line) + "\n")
        step += 1


main()
