"""A disk that is really full: the run still says how it ended."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import hil
from hil.core.errors import PreflightFailed
from hil.engine import Engine
from hil.planning.plan import Step
from hil.recording.run_directory import RESERVE, RESERVE_BYTES, RunDirectory

SPEC = """
hil: 1
name: full
robot: ur5
excitation: {kind: dwell, waypoints: 4, seed: 3}
warm_up: {duration_s: 60}
reference: {every: 0}
interlocks: [{kind: disk, enabled: false}]
"""


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(disk)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("this user may not mount a small file system")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=False)


@pytest.mark.thorough
def test_a_disk_that_fills_up_in_motion_ends_as_failed_and_keeps_what_there_was(
    tmp_path: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = tmp_path / "full.yaml"
    spec.write_text(SPEC, "utf-8")
    execute = Engine._execute

    def filling(engine: Engine, step: Step) -> None:
        if step.kind == "warmup" and not (small_disk / "other").exists():
            with (
                contextlib.suppress(OSError),
                (small_disk / "other").open("wb", buffering=0) as other,
            ):
                while True:
                    other.write(bytes(4096))
        execute(engine, step)

    monkeypatch.setattr(Engine, "_execute", filling)
    report = hil.run(hil.load(spec), runs=small_disk)
    run = RunDirectory.open(report.run)
    assert report.outcome == "failed"
    assert run.status == "failed"
    assert run.recordings
    assert not (report.run / RESERVE).exists()


@pytest.mark.thorough
def test_a_disk_without_room_for_the_reserve_fails_preflight_before_there_is_a_run(
    tmp_path: Path, small_disk: Path
) -> None:
    spec = tmp_path / "full.yaml"
    spec.write_text(SPEC, "utf-8")
    free = shutil.disk_usage(small_disk).free
    (small_disk / "other").write_bytes(bytes(free - RESERVE_BYTES // 2))
    runs = small_disk / "runs"
    with pytest.raises(PreflightFailed, match=r"disk: 0\.5 MB are free"):
        hil.run(hil.load(spec), runs=runs)
    assert not runs.exists()


def test_a_run_holds_a_reserve_until_its_end(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "reserve")
    assert (run.path / RESERVE).stat().st_size > 0
    run.write_start({"uid": "1"})
    run.write_stop("completed", "")
    assert not (run.path / RESERVE).exists()
    assert run.stop is not None
    assert RESERVE not in run.stop["sha256"]
