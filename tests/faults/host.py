"""One run with one thing going wrong at one kind of step; a process of its own.

Called by the fault matrix as `python host.py CASE.json`. What it runs is the real thing: `hil.run`
on the mock robot in wall time in *its* own process, over the driver's line. What cannot be done
from outside (a disk that refuses, a clock that jumps) is done to this process, when an observer
sees the step begin. To save time the plan is made beforehand, and no report is written.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import hil
from hil import report
from hil.cli.app import _end_like_ctrl_c
from hil.core.errors import HilError, exit_code_of
from hil.engine import Reply
from hil.planning.plan import read_plan
from hil.recording import recorder as recorder_module
from hil.recording.mcap_writer import McapWriter
from hil.workflow import recording
from hil.workflow.operator import OperatorChannel

STALL_S = 6.0
CLOCK_JUMP_S = 3600.0


class Injector:
    """An observer that lets something go wrong once, when a kind of step begins.

    Args:
        case: `at` (a kind of step), `after_s` (wall time) and `fault`.
        told: File that says when it happened, on the machine's monotonic clock.
    """

    def __init__(self, case: Mapping[str, Any], told: Path) -> None:
        self._case, self._told, self._done = case, told, False

    def notify(self, event: Mapping[str, Any]) -> None:
        """See `hil.engine.Observer`; `payload` steps are hit while the operator is asked."""
        kind = "payload" if event["kind"] == "prompt" else event.get("doing")
        wanted = event["kind"] == ("prompt" if self._case["at"] == "payload" else "step")
        if self._done or not wanted or kind != self._case["at"]:
            return
        self._done = True
        if self._case["fault"] == "raising observer":
            self._happened()
            raise RuntimeError("the plot window was closed")
        threading.Timer(self._case["after_s"], self._inject).start()

    def _inject(self) -> None:
        name = self._case["fault"]
        if name in FAULTS:
            FAULTS[name](self._happened)

    def _happened(self) -> None:
        draft = self._told.with_suffix(".draft")
        draft.write_text(json.dumps({"monotonic_s": time.monotonic()}), "utf-8")
        draft.rename(self._told)


Happened = Callable[[], None]


def _signal(number: signal.Signals, times: int = 1) -> Callable[[Happened], None]:
    """The last of several counts; they are so far apart that the kernel makes no two into one."""

    def send(happened: Happened) -> None:
        for _ in range(times - 1):
            os.kill(os.getpid(), number)
            time.sleep(0.05)
        happened()
        os.kill(os.getpid(), number)

    return send


def _disk_full(happened: Happened) -> None:
    """No file of this process may grow any more beyond what the recording has now."""
    largest = max(p.stat().st_size for p in Path("runs").rglob("*.partial"))
    write = McapWriter.write

    def refused(self: McapWriter, *arguments: Any) -> None:
        try:
            write(self, *arguments)
            self.flush(durable=False)
        except hil.core.errors.RecordingError:  # type: ignore[attr-defined]
            happened()
            raise

    McapWriter.write = refused  # type: ignore[method-assign]
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, resource.RLIM_INFINITY))


def _slow_disk(happened: Happened) -> None:
    happened()
    fsync = os.fsync

    def slow(descriptor: int) -> None:
        time.sleep(0.5)
        fsync(descriptor)

    os.fsync = slow


def _stalled_disk(happened: Happened) -> None:
    """A write that does not come back for seconds; rows wait in memory meanwhile."""
    write, stalled = McapWriter.write, threading.Event()

    def stall(self: McapWriter, *arguments: Any) -> None:
        if not stalled.is_set():
            stalled.set()
            happened()
            time.sleep(STALL_S)
        write(self, *arguments)

    McapWriter.write = stall  # type: ignore[method-assign]


def _recorder_death(happened: Happened) -> None:
    def die(self: Any) -> None:
        happened()
        raise MemoryError("the recorder's thread dies")

    recorder_module.Recorder._write_backlog = die  # type: ignore[method-assign]


def _clock_step(happened: Happened) -> None:
    happened()
    true_time = time.time
    time.time = lambda: true_time() + CLOCK_JUMP_S


def _driver_killed(happened: Happened) -> None:
    """The process that the robot's driver lives in ends without a word."""
    (pid,) = (pid for pid in _children() if b"hil.robot.subprocess_server" in _command_of(pid))
    happened()
    os.kill(pid, signal.SIGKILL)


def _children() -> list[int]:
    found = [path.read_text() for path in Path("/proc/self/task").glob("*/children")]
    return [int(pid) for pids in found for pid in pids.split()]


def _command_of(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


FAULTS: dict[str, Callable[[Happened], None]] = {
    "SIGINT twice": _signal(signal.SIGINT, 2),
    "SIGTERM": _signal(signal.SIGTERM),
    "kill -9": _signal(signal.SIGKILL),
    "disk full": _disk_full,
    "slow disk": _slow_disk,
    "stalled disk": _stalled_disk,
    "recorder death": _recorder_death,
    "clock step": _clock_step,
    "driver killed": _driver_killed,
}
"""What is done to this process; the other faults are the mock robot's own."""


def main() -> int:
    """Run the case; the exit code is the one `hil run` would have."""
    case = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    _end_like_ctrl_c()
    recording.plan_for = lambda *_: read_plan(Path("plan.json"))
    report.render_report = lambda *_: None

    def confirm(text: str, meanwhile: Callable[[], object]) -> Reply:
        until = time.monotonic() + case["prompt_s"]
        while time.monotonic() < until:
            meanwhile()
        return Reply(yes=True, who="the matrix")

    def attended() -> str:
        """Somebody is there, so that the first Ctrl-C pauses, but lets nothing go on."""
        return ""

    try:
        result = hil.run(
            hil.load("spec.yaml", "station.yaml"),
            runs="runs",
            observers=(Injector(case, Path("happened.json")),),
            desk=OperatorChannel(confirm, attended),
        )
    except HilError as error:  # before there is a run
        print(error.message, file=sys.stderr)  # noqa: T201
        return exit_code_of(error)
    return 0 if result.error is None else exit_code_of(result.error)


if __name__ == "__main__":
    sys.exit(main())
