"""Run directories for the tests of the catalogue: documents alone, dated in the past."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import pytest

PAST_S = 1_700_000_000.0
"""When their files were changed last: long enough ago to be believed."""


def settle(run: Path, at: float = PAST_S) -> None:
    """Date everything in a run back."""
    for path in [*run.rglob("*"), run]:
        os.utime(path, (at, at))


def write_run(
    root: Path,
    number: int,
    *,
    day: str = "2026-11-20",
    robot: str = "ur5",
    name: str = "fourier",
    outcome: str | None = "completed",
    fits: dict[str, float] | None = None,
    start: dict[str, Any] | None = None,
    stop: dict[str, Any] | None = None,
    description: str = "",
    recording: bytes | None = None,
) -> Path:
    """A run; without `outcome` it was interrupted.

    Args:
        root: Folder of runs.
        number: Its number; the minute it was started, too.
        day: When.
        robot: Of the station.
        name: Of the experiment.
        outcome: In its stop document.
        fits: Estimator → RMSE of either joint on held-out data.
        start, stop: More for its documents.
        description: Of the spec.
        recording: Content of `recording/00.mcap`.
    """
    run = root / day / robot / f"{number:04d}-{name}"
    (run / "recording").mkdir(parents=True)
    content = recording if recording is not None else f"{robot} {number}".encode()
    (run / "recording" / "00.mcap").write_bytes(content)
    (run / "spec.yaml").write_text(f"hil: 1\nname: {name}\ndescription: {description!r}\n")
    document = {
        "hil_run": 1, "uid": f"uid-{robot}-{number}", "experiment": name, "operator": "ada",
        "started": f"{day}T{number // 60 % 24:02d}:{number % 60:02d}:00.000+00:00",
        "robot": {"model": "ur5", "identity": {"serial": f"{robot}-s"}},
        "loads": [{"mass_kg": 0.0}], "robot_name": robot,
    }  # fmt: skip
    (run / "start.json").write_text(json.dumps(document | (start or {})))
    for estimator, rmse in (fits or {}).items():
        folder = run / "fit" / f"{estimator}-0123456789ab"
        folder.mkdir(parents=True)
        held_out = {"unit": "A", "total": {"rmse_raw": [rmse, rmse]}}
        evaluation = {"estimator": estimator, "held_out": held_out}
        (folder / "evaluation.json").write_text(json.dumps(evaluation))
    if outcome is not None:
        digests = {"recording/00.mcap": hashlib.sha256(content).hexdigest()}
        told = {"outcome": outcome, "reason": "", "device_s": 60.0 + number, "samples": 100}
        told |= {"hil_run": 1, "gaps": 0, "sha256": digests, "events_bytes": 0, **(stop or {})}
        (run / "stop.json").write_text(json.dumps(told))
    settle(run)
    return run


def close_folders(monkeypatch: pytest.MonkeyPatch, *closed: Path) -> None:
    """Let nothing in these folders be looked at, as if they were another user's (mode 700)."""
    stat = os.stat

    def refusing(path: Any, *arguments: Any, **more: Any) -> os.stat_result:
        real = None if isinstance(path, int) else Path(os.path.realpath(path))
        inside = () if real is None else (*real.parents, *[real][: str(path).endswith("/.")])
        if not set(closed).isdisjoint(inside):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return stat(path, *arguments, **more)

    monkeypatch.setattr(os, "stat", refusing)
