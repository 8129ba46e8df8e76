"""A query over 2,000 run directories by the catalogue, against reading what it asks for in each.

Directories hold documents of the sizes that runs leave (two fits each, no recordings), all in the
page cache. Whoever is timed gives the same runs.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.recording.run_directory import number_of
from hil.runs.catalogue import FILE, find_runs
from hil.runs.listing import run_paths

RUNS, QUICK_RUNS = 2_000, 60
REPEATS = 3
ROBOTS = 10
LONG_AGO_S = 1_700_000_000.0
QUERY = ("robot=ur5-00[0-4]", "rmse<0.1")


def run(quick: bool = False) -> dict[str, Any]:
    """CPU seconds: the view made, asked, asked after one run has changed; and its peer.

    Args:
        quick: 60 directories.
    """
    count = QUICK_RUNS if quick else RUNS
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        paths = [write_run(root, number) for number in range(1, count + 1)]
        size = sum(file.stat().st_size for file in paths[0].rglob("*") if file.is_file())
        make_s, _ = _seconds(lambda: find_runs(*QUERY, runs=root, rebuild=True))
        ask_s, found = _seconds(lambda: find_runs(*QUERY, runs=root))
        read_s, known = _seconds(lambda: _by_reading(root))
        changed_s, _ = _seconds(lambda: _after_a_change(root, paths[0]))
        view_size = (root / FILE).stat().st_size
    if [one["run"] for one in found] != known:
        raise AssertionError("the catalogue does not say what the directories say")
    return {
        "name": "catalogue",
        "figures": {
            "runs": count,
            "found": len(found),
            "bytes_per_run": size,
            "catalogue_bytes_per_run": view_size / count,
            "make_s": make_s,
            "query_s": ask_s,
            "query_after_one_change_s": changed_s,
            "reading_s": read_s,
        },
        "ratios": {
            "query_vs_reading": read_s / ask_s,
            "query_after_one_change_vs_reading": read_s / changed_s,
        },
    }


def _by_reading(root: Path) -> list[str]:
    """Answer the same query by reading every run directory."""
    wanted = {f"ur5-{k:03d}" for k in range(5)}
    found = [
        (number_of(path), str(path))
        for path in run_paths(root)
        if path.parent.name in wanted and any(map(_is_good, path.glob("fit/*/evaluation.json")))
    ]
    return [run for _, run in sorted(found)]


def _is_good(evaluation: Path) -> bool:
    errors = json.loads(evaluation.read_bytes())["held_out"]["total"]["rmse_raw"]
    return bool(sum(errors) / len(errors) < 0.1)


def _after_a_change(root: Path, path: Path) -> None:
    verdict = path / "verdict.json"
    verdict.write_text(json.dumps({"passed": True, "told": time.time()}))
    find_runs(*QUERY, runs=root)


def _seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the shortest of several times, and the last result."""
    times = []
    for _ in range(REPEATS):
        began = time.process_time()
        result = work()
        times.append(time.process_time() - began)
    return min(times), result


def write_run(root: Path, number: int) -> Path:
    """Create a run directory without a recording, with an old modification time."""
    robot, day = f"ur5-{number % ROBOTS:03d}", f"2026-{1 + number // 200 % 12:02d}-11"
    path = root / day / robot / f"{number:04d}-fourier"
    for estimator, rmse in (("rigid-wls", 0.13), ("rigid-hysteresis", 0.05 + 0.01 * (number % 9))):
        folder = path / "fit" / f"{estimator}-0123456789ab"
        folder.mkdir(parents=True)
        errors = [rmse * (1.0 + 0.01 * j) for j in range(6)]
        row = {"by": "trajectory", "samples": 1250, "rmse_raw": errors, "rmse_filtered": errors}
        held_out = {"unit": "A", "total": row, "tables": [row] * 60}
        told = {"estimator": estimator, "held_out": held_out}
        (folder / "evaluation.json").write_text(json.dumps(told, indent=2))
    start = {
        "hil_run": 1, "uid": f"{number}", "started": f"{day}T08:00:00.000+00:00", "operator": "ada",
        "experiment": "fourier", "packages": {f"package-{k}": "1.2.3" for k in range(40)},
        "robot": {"model": "ur5", "identity": {"serial": robot}}, "loads": [{"mass_kg": 0.0}],
    }  # fmt: skip
    stop = {"hil_run": 1, "outcome": "completed", "reason": "", "device_s": 90.0, "samples": 11250}
    spec = "hil: 1\nname: fourier\ndescription: eight trajectories\n" + "# a comment\n" * 150
    (path / "start.json").write_text(json.dumps(start, indent=2))
    (path / "stop.json").write_text(json.dumps({**stop, "gaps": 0, "sha256": {}}, indent=2))
    (path / "verdict.json").write_text(json.dumps({"passed": number % 3 > 0}))
    (path / "spec.yaml").write_text(spec)
    for file in [*path.rglob("*"), path]:
        os.utime(file, (LONG_AGO_S, LONG_AGO_S))
    return path


if __name__ == "__main__":
    print(run())
