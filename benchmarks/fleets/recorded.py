"""Runs of a simulated fleet, every robot another individual: recorded and not fitted."""

from __future__ import annotations

from concurrent.futures import Executor
from pathlib import Path

ROBOTS, FIRST_SEED = 100, 2001

SPEC = """\
hil: 1
name: fleet-bench
robot: {robot}
excitation: {{kind: fourier, trajectories: 3, harmonics: 5, fundamental_hz: 0.2, seed: 11}}
warm_up: {{duration_s: 0}}
reference: {{every: 0}}
validate: {{hold_out: {{trajectories: 1}}}}
"""


def recordings(folder: Path, count: int, executor: Executor) -> list[Path]:
    """Run directories of so many robots, in their order."""
    names = [f"ur5-{k + 1:03d}" for k in range(count)]
    robots = "\n".join(
        f"  {name}: {{driver: mock, model: ur5, options: {{seed: {FIRST_SEED + k}}}}}"
        for k, name in enumerate(names)
    )
    (folder / "station.yaml").write_text(f"hil_station: 1\nrobots:\n{robots}\n", "utf-8")
    return list(executor.map(_recorded, [folder] * count, names))


def _recorded(folder: Path, robot: str) -> Path:
    from hil.maintenance.fleet_specs import experiment_for
    from hil.workflow.running import run as run_experiment

    text = SPEC.format(robot=robot)
    experiment = experiment_for(text, folder, folder / "station.yaml", folder / "spec.yaml")
    report = run_experiment(experiment, runs=folder / "runs")
    if report.error is not None or report.outcome != "completed":
        raise AssertionError(f"{robot}: {report.outcome}: {report.error}")
    (report.run / "report.html").unlink(missing_ok=True)  # five megabytes each that nobody reads
    return report.run.resolve()
