"""kill -9 at random moments of a 500 Hz recording: what is lost, beside a plain mcap Writer.

Every child records the same rows three times: through the Recorder, in parts; through mcap's Writer
as it comes, which hands over full chunks of 1 MiB only; and through one whose chunks are as small
as 0.1 s of rows and flushed at once. What our recorder left is recovered as a run's. What was
handed to all before the kill stands in a memory map the child writes. For every other child an
fsync takes half a second longer, as on a poor disk.
"""

from __future__ import annotations

import functools
import json
import mmap
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hil.core.errors import DataError
from hil.core.typing import StructArray
from hil.recording import Attachment, McapWriter, Recorder, read_topic
from hil.recording.recovery import recover
from hil.recording.run_directory import RunDirectory
from hil.robot.state import STATE_TOPIC, state_topic

RATE_HZ = 500.0
KILLS, QUICK_KILLS = 200, 10
AT_ONCE = 8
SHORTEST_S, LONGEST_S, QUICK_LONGEST_S = 0.2, 6.0, 2.0
SLOW_FSYNC_S = 0.5
PART_BYTES = 400_000
"""A new part about every two seconds, so that kills fall into seams as well."""

SMALL_CHUNK_S = 0.1

_NAMES = [f"joint_{i}" for i in range(1, 7)]
_TOPIC = state_topic(6, RATE_HZ, clock="host", effort_unit="A")
_HANDED = struct.Struct("<qdd")
"""Rows handed over, host time of the first and of the last of them [s]."""


class Loss(NamedTuple):
    """What one kill did to one way of recording."""

    readable: bool
    lost_s: float
    files: int


def run(quick: bool = False, kills: int | None = None) -> dict[str, Any]:
    """Kill children that record, and read what they leave.

    Args:
        quick: Ten kills instead of 200, and shorter lives.
        kills: How many instead.
    """
    count = kills or (QUICK_KILLS if quick else KILLS)
    longest = QUICK_LONGEST_S if quick else LONGEST_S
    with tempfile.TemporaryDirectory() as folder:
        lives = _lives(Path(folder), count, longest)
        ours = [_loss(life, _read_ours) for life in lives]
        unrecovered = sum(not _recovers(life) for life in lives)
        slow = [loss.lost_s for loss, life in zip(ours, lives, strict=True) if _on_slow_disk(life)]
        plain, small = (
            [_loss(life, functools.partial(_read_peer, name)) for life in lives]
            for name in ("plain", "small")
        )
    own = [loss.lost_s for loss in ours]
    return {
        "name": "crash",
        "figures": {
            "kills": count,
            "files": sum(loss.files for loss in ours),
            "unreadable": sum(not loss.readable for loss in ours),
            "unrecovered_runs": unrecovered,
            "worst_loss_s": max(own),
            "median_loss_s": float(np.median(own)),
            "worst_loss_slow_fsync_s": max(slow, default=0.0),
            **_figures_of("plain_writer", plain),
            **_figures_of("small_chunk_writer", small),
        },
        "ratios": {
            "worst_loss_plain_writer_vs_recorder": max(loss.lost_s for loss in plain) / max(own),
            "worst_loss_small_chunk_writer_vs_recorder": max(s.lost_s for s in small) / max(own),
        },
    }


def _figures_of(peer: str, losses: list[Loss]) -> dict[str, float]:
    lost = [loss.lost_s for loss in losses]
    return {
        f"{peer}_without_a_row": sum(not loss.readable for loss in losses),
        f"{peer}_worst_loss_s": max(lost),
        f"{peer}_median_loss_s": float(np.median(lost)),
    }


def _lives(folder: Path, count: int, longest_s: float) -> list[Path]:
    """Let children record, several at once, and kill each at its time; their folders."""
    draw = random.Random(0)
    waiting = [folder / f"{number:04d}" for number in range(count)]
    done: list[Path] = []
    running: list[_Child] = []
    try:
        while waiting or running:
            while waiting and len(running) < AT_ONCE:
                running.append(_Child(waiting.pop(), draw.uniform(SHORTEST_S, longest_s)))
            for child in [child for child in running if child.killed_when_due()]:
                running.remove(child)
                done.append(child.folder)
            time.sleep(0.002)
    finally:
        for child in running:
            child.kill()
    return done


class _Child:
    def __init__(self, folder: Path, life_s: float) -> None:
        folder.mkdir()
        (folder / "handed").write_bytes(bytes(_HANDED.size))
        self.folder, self._life_s, self._born = folder, life_s, 0.0
        # -P, or the script's neighbour mcap.py would stand for the package mcap.
        self._process = subprocess.Popen([sys.executable, "-P", __file__, str(folder)])

    def killed_when_due(self) -> bool:
        """Whether its time, counted from its first row, was over; it is dead then."""
        now = time.monotonic()
        if not self._born and any((self.folder / "handed").read_bytes()):
            self._born = now
        if self._process.poll() is not None:
            raise AssertionError(f"a recording child ended by itself: {self._process.returncode}")
        if not self._born or now - self._born < self._life_s:
            return False
        self.kill()
        return True

    def kill(self) -> None:
        """Kill it, whatever it is doing."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()


def _loss(folder: Path, read: Callable[[Path], tuple[StructArray, int]]) -> Loss:
    """Compare what can be read with what was handed over."""
    handed, first, last = _HANDED.unpack((folder / "handed").read_bytes())
    try:
        rows, files = read(folder)
    except DataError:
        return Loss(False, last - first, 0)
    # The kill may have come after the row was handed over and before that was noted.
    whole = len(rows) <= handed + 1 and (rows["segment"] == np.arange(len(rows))).all()
    kept_until = float(rows["host_time"][-1]) if len(rows) else first
    return Loss(bool(whole), max(0.0, last - kept_until), files)


def _read_ours(folder: Path) -> tuple[StructArray, int]:
    parts = RunDirectory(folder / "ours").recordings
    rows = [read_topic(part, salvage=part.suffix != ".mcap") for part in parts]
    return np.concatenate(rows), len(parts)


def _recovers(folder: Path) -> bool:
    """Whether `hil recover` makes whole files of a run, with the rows that could be read before."""
    rows, files = _read_ours(folder)
    refused = recover(folder / "ours").error
    whole = all(path.suffix == ".mcap" for path in RunDirectory(folder / "ours").recordings)
    now, files_now = _read_ours(folder)
    return refused is None and whole and files_now == files and now.tobytes() == rows.tobytes()


def _read_peer(name: str, folder: Path) -> tuple[StructArray, int]:
    """All that mcap's own stream reader finds before the tear."""
    return read_topic(folder / f"{name}.mcap", salvage=True), 1


def _on_slow_disk(folder: Path) -> bool:
    return int(folder.name) % 2 == 1


def _slow_fsync(fsync: Callable[[Any], None]) -> Callable[[Any], None]:
    def slowly(fd: Any) -> None:
        time.sleep(SLOW_FSYNC_S)
        fsync(fd)

    return slowly


def _record_until_killed(folder: Path) -> None:
    recorder = _recorder(folder / "ours")
    if _on_slow_disk(folder):
        setattr(os, "fsync", _slow_fsync(os.fsync))  # noqa: B010
    row_bytes = _TOPIC.dtype.itemsize
    peers = [
        _plain_writer(folder / "plain.mcap"),
        _plain_writer(folder / "small.mcap", chunk_size=int(SMALL_CHUNK_S * RATE_HZ * row_bytes)),
    ]
    with (folder / "handed").open("r+b") as file:
        handed = mmap.mmap(file.fileno(), _HANDED.size)
    rows = _moving_arm()
    number, first, due = 0, 0.0, time.monotonic()
    while True:
        row = rows[number % len(rows)][None].copy()
        row["segment"], now = number, time.time()
        row["device_time"] = row["host_time"] = now
        recorder.put(STATE_TOPIC, row)
        for peer in peers:
            peer(row, int(now * 1e9))
        number, first = number + 1, first or now
        handed[:] = _HANDED.pack(number, first, now)
        due += 1 / RATE_HZ
        time.sleep(max(0.0, due - time.monotonic()))


def _recorder(folder: Path) -> Recorder:
    run = RunDirectory(folder)
    (folder / "recording").mkdir(parents=True)
    run.write_start({"uid": folder.parent.name})

    def open_part(part: int) -> McapWriter:
        return McapWriter(
            run.part_path(0, part), [_TOPIC], attachments=_papers(), joint_names=_NAMES
        )

    return Recorder(open_part(0), next_part=open_part, rotate_bytes=PART_BYTES)


def _plain_writer(path: Path, **options: int) -> Callable[[StructArray, int], None]:
    from mcap.writer import Writer

    file = path.open("wb")
    writer = Writer(file, **options)  # type: ignore[arg-type]
    writer.start("ros2")
    for paper in _papers():
        writer.add_attachment(0, 0, paper.name, paper.media_type, paper.data)
    schema = writer.register_schema(_TOPIC.schema_name, "ros2msg", _TOPIC.schema_text.encode())
    channel = writer.register_channel(STATE_TOPIC, "cdr", schema, _TOPIC.channel_metadata)

    def add(row: StructArray, now_ns: int) -> None:
        writer.add_message(channel, now_ns, b"\0\1\0\0" + row.tobytes(), now_ns)
        if options:
            file.flush()

    return add


def _papers() -> list[Attachment]:
    """Return documents of the size and kind of a run of 650 poses."""
    draw = random.Random(0)
    poses = [{"q_rad": [draw.uniform(-3, 3) for _ in range(6)], "step": i} for i in range(1300)]
    spec = b"hil: 1\nname: ur5-dwell-650\n" * 40
    return [
        Attachment("spec.yaml", "application/yaml", spec),
        Attachment("station.yaml", "application/yaml", spec),
        Attachment("plan.json", "application/json", json.dumps(poses).encode()),
        Attachment("start.json", "application/json", json.dumps({"packages": "x" * 4000}).encode()),
    ]


def _moving_arm() -> StructArray:
    """(5000,) rows as a moving arm gives them: noise in what is measured, smooth commands."""
    noise = np.random.default_rng(0)
    rows = _TOPIC.blank(5000)
    phase = np.arange(5000)[:, None] / RATE_HZ * np.arange(1, 7) * 0.3
    for name in ("q_target", "qd_target", "qdd_target"):
        rows[name] = np.sin(phase)
    for name in ("q", "qd", "effort"):
        rows[name] = np.sin(phase) + noise.normal(0.0, 1e-3, phase.shape)
    rows["temperature"] = 30.0
    return rows


if __name__ == "__main__":
    _record_until_killed(Path(sys.argv[1]))
