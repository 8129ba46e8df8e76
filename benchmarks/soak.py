"""A day at 500 Hz through the Recorder, faster than real time: nothing lost, memory flat.

Chunks are as small as in wall time (0.1 s of data), so index and file count are those of a real
day. Every finished part is read back by a process of its own, which checks that it continues the
one before without a gap and carries on a checksum of all rows; then the part is deleted.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core.errors import DataError
from hil.core.typing import FloatArray, StructArray
from hil.recording import Counts, McapWriter, Recorder, read_topic
from hil.recording.recording_files import part_name, recordings_in
from hil.robot.state import STATE_TOPIC, state_topic

RATE_HZ = 500.0
HOURS, QUICK_HOURS = 1.0, 0.05
PART_BYTES = 128e6
MEMORY_BOUND_MB = 8.0
"""How much higher the last tenth of the run may peak than the second tenth."""

_ROWS_PER_PUT = 10
_ROWS_PER_FLUSH = 50
_GAP_EVERY, _GAP_ROWS = 900_000, 3
"""Samples the source leaves out: gaps that have an explanation and must be found, no others."""
_SAMPLES_PER_MEMORY_READING = 5_000
_MOST_WAITING_PARTS = 3
_TOPIC = state_topic(6, RATE_HZ, clock="virtual", effort_unit="A")


class _AsInWallTime(McapWriter):
    """Ends a chunk every 50 rows, which is what the recorder does every 0.1 s of wall time."""

    def write(self, topic: str, rows: StructArray) -> None:
        for begin in range(0, len(rows), _ROWS_PER_FLUSH):
            super().write(topic, rows[begin : begin + _ROWS_PER_FLUSH])
            self.flush(durable=False)


@dataclass
class _Seen:
    """What has been handed over, or read back, so far: how many rows, which, what they count to."""

    crc: int
    counts: Counts
    parts: int = 0

    def take(self, rows: StructArray) -> None:
        self.crc = zlib.crc32(rows.tobytes(), self.crc)
        self.counts = self.counts.after(rows, RATE_HZ)


def run(quick: bool = False, hours: float | None = None, mock: bool = False) -> dict[str, Any]:
    """Record, read back, compare.

    Args:
        quick: 3 simulated minutes instead of an hour.
        hours: How much to simulate instead [h].
        mock: Rows of an embedded mock UR5e that moves, instead of ready-made ones.

    Raises:
        AssertionError: Rows were lost, changed or doubled, a gap has no explanation, or memory
            grew.
    """
    samples = round((hours or (QUICK_HOURS if quick else HOURS)) * 3600 * RATE_HZ)
    source = _mock_rows(samples) if mock else _synthetic_rows(samples)
    handed, memory, behind = _Seen(0, Counts()), [], [0.0]
    start, cpu = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        check = _Check(Path(folder))
        with _recorder(Path(folder)) as recorder:
            for rows in source:
                for begin in range(0, len(rows), _ROWS_PER_PUT):
                    recorder.put(STATE_TOPIC, rows[begin : begin + _ROWS_PER_PUT])
                handed.take(rows)
                if handed.counts.samples % _SAMPLES_PER_MEMORY_READING < len(rows):
                    recorder.put_event({"t": float(rows["host_time"][0]), "kind": "checkpoint"})
                    memory.append(_resident_mb())
                    behind.append(recorder.behind_s)
                    check.finished_parts(_MOST_WAITING_PARTS)
        check.finished_parts(0)
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    growth = _growth(np.array(memory))
    planted = 0 if mock else (samples - 1) // _GAP_EVERY
    _require_equal(handed, check.seen, planted)
    if growth > MEMORY_BOUND_MB:
        raise AssertionError(f"memory grew by {growth:.1f} MB")
    return {
        "name": "soak",
        "figures": {
            "simulated_h": samples / RATE_HZ / 3600,
            "wall_s": wall,
            "times_real_time": samples / RATE_HZ / wall,
            "cpu_s": cpu,
            "rows": handed.counts.samples,
            "parts": check.seen.parts,
            "gigabytes": check.bytes / 1e9,
            "gaps_made": planted,
            "gaps_without_explanation": check.seen.counts.gaps - planted,
            "memory_mb": float(np.max(memory)),
            "memory_growth_mb": growth,
            "worst_behind_s": max(behind),
        },
        "ratios": {},
    }


def _require_equal(handed: _Seen, read: _Seen, planted: int) -> None:
    """Everything that was handed over has been read back, and gaps only where they were made."""
    gaps = read.counts.gaps
    if read.crc != handed.crc or read.counts != handed.counts:
        raise AssertionError(f"read back {read.counts} of {handed.counts}, or other bytes")
    if (gaps, read.counts.missing) != (planted, planted * _GAP_ROWS) or read.counts.duplicates:
        raise AssertionError(f"{gaps} gaps instead of {planted}: {read.counts}")


def _growth(memory: FloatArray) -> float:
    """Peak of the last tenth over that of the second one, when everything is in use [MB]."""
    tenth = max(1, len(memory) // 10)
    return float(memory[-tenth:].max() - memory[tenth : 2 * tenth + 1].max())


def _recorder(folder: Path) -> Recorder:
    def open_part(part: int) -> McapWriter:
        return _AsInWallTime(
            folder / part_name(0, part), [_TOPIC], joint_names=[f"joint_{i}" for i in range(6)]
        )

    return Recorder(open_part(0), next_part=open_part, rotate_bytes=PART_BYTES, on_backlog="wait")


class _Check:
    """Has finished parts read back in order, one process at a time, and deletes them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.seen, self.bytes = _Seen(0, Counts()), 0
        self._reading: tuple[Path, subprocess.Popen[str]] | None = None

    def finished_parts(self, most_waiting: int) -> None:
        """Go on with reading; waits while more than `most_waiting` finished parts are there."""
        while finished := self._finished():
            if self._reading is None:
                self._reading = finished[0], self._reader_of(finished[0])
            elif len(finished) > most_waiting or self._reading[1].poll() is not None:
                self._note(*self._reading)
            else:
                return

    def _finished(self) -> list[Path]:
        return [path for path in recordings_in(self._folder) if path.suffix == ".mcap"]

    def _reader_of(self, part: Path) -> subprocess.Popen[str]:
        before = json.dumps({"crc": self.seen.crc, "counts": asdict(self.seen.counts)})
        # -P, or this script's neighbour mcap.py would stand for the package mcap.
        command = [sys.executable, "-P", __file__, str(part), before]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def _note(self, part: Path, reader: subprocess.Popen[str]) -> None:
        told, _ = reader.communicate()
        if reader.returncode:
            raise AssertionError(f"{part.name} cannot be read back")
        after = json.loads(told)
        self.seen = _Seen(after["crc"], Counts(**after["counts"]), self.seen.parts + 1)
        self.bytes += part.stat().st_size
        part.unlink()
        self._reading = None


def _read_back(part: Path, before: dict[str, Any]) -> None:
    """In a process of its own: continue checksum and counts over a finished part."""
    seen = _Seen(before["crc"], Counts(**before["counts"]))
    try:
        seen.take(read_topic(part))
    except DataError as error:
        sys.exit(error.message)
    print(json.dumps({"crc": seen.crc, "counts": asdict(seen.counts)}))


def _synthetic_rows(samples: int) -> Iterator[StructArray]:
    """Rows of a moving arm, a second at a time, with a gap every half hour."""
    ready = _noisy_rows(5000)
    for begin in range(0, samples, second := round(RATE_HZ)):
        numbers = np.arange(begin, min(begin + second, samples))
        rows = ready[begin % len(ready) :][: len(numbers)].copy()
        rows["device_time"] = numbers / RATE_HZ
        rows["host_time"] = 1.8e9 + rows["device_time"]
        rows["segment"] = numbers
        if begin and begin % _GAP_EVERY == 0:
            rows = rows[_GAP_ROWS:]
        yield rows


def _noisy_rows(number: int) -> StructArray:
    noise = np.random.default_rng(0)
    rows = _TOPIC.blank(number)
    phase = np.arange(number)[:, None] / RATE_HZ * np.arange(1, 7) * 0.3
    for name in ("q_target", "qd_target", "qdd_target"):
        rows[name] = np.sin(phase)
    for name in ("q", "qd", "effort"):
        rows[name] = np.sin(phase) + noise.normal(0.0, 1e-3, phase.shape)
    rows["temperature"] = 30.0
    return rows


def _mock_rows(samples: int) -> Iterator[StructArray]:
    """Rows of an embedded mock UR5e that swings there and back, whole minutes."""
    from hil.robot import Segment
    from hil_mock_robot.embedded.robot import MockRobot

    robot = MockRobot("soak", "ur5e", rate_hz=RATE_HZ, seed=7)
    robot.connect()
    t = np.arange(round(60 * RATE_HZ)) / RATE_HZ
    w = 2 * np.pi * np.round(np.arange(3, 9)) / 60
    home = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
    ramp, size = np.sin(np.pi * t / 60)[:, None] ** 4, 0.4
    q = home + size * ramp * np.sin(t[:, None] * w)
    qd = np.gradient(q, 1 / RATE_HZ, axis=0)
    qdd = np.gradient(qd, 1 / RATE_HZ, axis=0)
    for sample in range(0, samples, len(q)):
        robot.prepare(Segment(sample // len(q), "trajectory", q, qd, qdd, 1.0, 1.0))
        robot.start()
        left = len(q)
        while left:
            rows = robot.read()
            left -= len(rows)
            yield rows


def _resident_mb() -> float:
    """Memory this process has in use [MB]."""
    with contextlib.suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    _read_back(Path(sys.argv[1]), json.loads(sys.argv[2]))
