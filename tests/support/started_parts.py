"""A small experiment that asks something and then moves, on a mock in wall time or on its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hil.workflow.background_runs import Started, start_run
from tests.support.waiting import until

PROMPT = "Remove everything from the flange"

SPEC = f"""\
hil: 1
name: asks-first
robot: ur5
excitation: {{kind: dwell, waypoints: 12, dwell_s: 0.095, samples_per_dwell: 10, approach: both,
  max_velocity_deg_s: 60, max_acceleration_deg_s2: 80, seed: 7}}
loads: [{{mass_kg: 0, prompt: {PROMPT}}}]
warm_up: {{duration_s: 5}}
reference: {{every: 0}}
"""
WALL = """\
hil_station: 1
name: wall
robots: {ur5: {driver: mock, model: ur5, options: {clock: wall, speed: 4}}}
"""


def written(folder: Path) -> tuple[Path, Path]:
    """The spec and a station whose robot takes as long as a real one."""
    spec, station = folder / "asks.yaml", folder / "wall.yaml"
    spec.write_text(SPEC, "utf-8")
    station.write_text(WALL, "utf-8")
    return spec, station


@contextmanager
def begun(folder: Path, *, wall: bool = True) -> Iterator[tuple[Started, Path]]:
    """Such a run in the background, asking, and its directory; gone on the way out."""
    spec, station = written(folder)
    started = start_run(spec, folder / "runs", station=station if wall else None, operator="anna")
    try:
        until(lambda: started.made or not started.alive, 30)
        assert started.made, started.last_words
        yield started, started.made[0]
    finally:
        started.cancel()
        until(lambda: not started.alive, 20)
