"""The simulated fleet of the how-to: as new, then a probe years later, all by its commands."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from hil.cli.app import app
from tests.support.paths import EXPERIMENTS

AGED = EXPERIMENTS / "stations" / "fleet_mock.yaml"


def hil(*arguments: object) -> dict[str, Any]:
    """What a command that succeeds says."""
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def walked(
    folder: Path, robots: Sequence[str], first: Path, probe: Path
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]]:
    """What `fit --register` of the new fleet, `drift` and `report` of the aged one say.

    Args:
        folder: For everything.
        robots: Patterns.
        first: The experiment champions are fitted to.
        probe: The experiment of the aged fleet.
    """
    script = EXPERIMENTS / "scripts" / "fleet_station.py"
    new = folder / "fleet_as_new.yaml"
    made = subprocess.run([sys.executable, script, "--as-new"], capture_output=True, check=True)
    new.write_bytes(made.stdout)
    registry = ("--registry", folder / "registry")
    named = [word for one in robots for word in ("--robots", one)]
    where = (*named, "--runs", folder / "runs", "--workers", 2)
    fleet = hil("fleet", "run", first, "--station", new, *where)["fleet"]
    fits = hil("fleet", "fit", fleet, "-e", "rigid-wls", "--register", *registry)["fits"]
    fleet = hil("fleet", "run", probe, "--station", AGED, *where)["fleet"]
    probes = hil("fleet", "drift", fleet, *registry)["probes"]
    hil("fleet", "fit", fleet, "-e", "rigid-wls")
    return fits, probes, hil("fleet", "report", fleet, *registry)
