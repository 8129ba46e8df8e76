"""Small fleets of mock robots, and commands about them in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SPEC = """\
hil: 1
name: small
robot: nobody   # replaced by every robot of the fleet
excitation: {kind: fourier, trajectories: 1, fundamental_hz: 0.5, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
"""
FITTED = SPEC.replace(
    "trajectories: 1, fundamental_hz: 0.5", "trajectories: 3, fundamental_hz: 0.2"
)
FITTED += "fit: [{estimator: rigid-wls}]\nvalidate: {hold_out: {trajectories: 1}}\n"
FITTED += "accept: {rmse: {max: 0.5, unit: A, per: mean}}\n"
SLOW = "clock: wall, speed: 2"
"""Options of a mock whose whole run takes some seconds."""


def written(folder: Path, options: Mapping[str, str], spec: str = SPEC) -> tuple[Path, Path]:
    """Spec and station of mock UR5s with options by name."""
    path, station = folder / "small.yaml", folder / "station.yaml"
    path.write_text(spec, "utf-8")
    lines = [
        f"  {name}: {{driver: mock, model: ur5, in_service: {2016 + k}-03-01, options: {{{told}}}}}"
        for k, (name, told) in enumerate(options.items())
    ]
    station.write_text("hil_station: 1\nrobots:\n" + "\n".join(lines) + "\n", "utf-8")
    return path, station


def command(*arguments: object, **more: Any) -> subprocess.Popen[str]:
    """A `hil` of its own, leader of its process group."""
    code = "from hil.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        stdin=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"}, **more,
    )  # fmt: skip


def told(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Its document, when it has ended."""
    out, err = process.communicate(timeout=60)
    try:
        document: dict[str, Any] = json.loads(out)
    except ValueError:
        raise AssertionError(f"exit code {process.returncode}: {out}{err}") from None
    return document


def moving(runs: Path, robot: str) -> int:
    """Process that moves a robot, 0 while none does."""
    for lock in runs.glob(f"*/{robot}/*/.lock"):
        events = lock.with_name("events.jsonl")
        if events.is_file() and '"running"' in events.read_text("utf-8"):
            try:
                return int(json.loads(lock.read_text("utf-8"))["pid"])
            except ValueError:  # it is being written
                return 0
    return 0


def measurements(runs: Path, robot: str) -> list[Path]:
    """Recordings of a robot, whole or not."""
    return sorted(runs.glob(f"*/{robot}/*/recording/*"))
