"""Lives and deaths of a pipeline, and what must hold however often it died."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from hil.core.typing import FloatArray
from hil.evaluation.fitting import usable_part
from hil.importers.sources import load_source
from hil.maintenance.ledger import Ledger
from hil.maintenance.stages import FOLDER
from hil.models.model_registry import Registry
from hil.recording.run_directory import RunDirectory
from tests.support.paths import FILES
from tests.support.pipeline_parts import occasion

SCRIPT = FILES / "pipeline_dies.py"
SECOND = occasion(1, "campaign").id


def died(folder: Path, seed: int, lives: int) -> int:
    """Have the script do its work in a folder; how many lives it took."""
    told = subprocess.run(
        [sys.executable, str(SCRIPT), str(folder), str(seed), str(lives)],
        capture_output=True, text=True, check=False, timeout=900,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    return int(json.loads(told.stdout)["lives"])


def require_once(folder: Path) -> dict[str, Any]:
    """Every run once, every version once, one decision; what the work returned."""
    starts = [json.loads(path.read_bytes()) for path in folder.glob("runs/*/*/*/start.json")]
    of = Counter(start["occasion"].removeprefix("weekly/") for start in starts)
    first = f"{occasion(0).id}/campaign"
    assert of == Counter(
        [first, *(f"{SECOND}/{stage}" for stage in ("probe", "campaign", "check"))]
    )

    registry = Registry(folder / "registry")
    for version in registry.versions("ur5"):
        version.verify()
    told: dict[str, Any] = json.loads((folder / f"{SECOND}.json").read_bytes())
    done = [(entry.event, entry.version) for entry in registry.log("ur5")]
    last = "promoted" if told["decision"]["promoted"] else "kept"
    assert done == [
        ("registered", 1), ("challenger", 1), ("promoted", 1),
        ("registered", 2), ("challenger", 2), (last, 2),
    ]  # fmt: skip
    assert registry.rebuild("ur5").champion == int(told["champion"][1:])
    probes = (registry.root / "ur5" / "probes.jsonl").read_bytes().splitlines()
    assert len(probes) == 1
    stages = {path.stem for path in (folder / "occasions" / SECOND / FOLDER).glob("*.json")}
    assert len(stages) == 9
    return told


def require_accounted(folder: Path) -> None:
    """Both occasions were done once by the ledger, however often they were begun."""
    lines = Ledger.read(folder).lines
    done = [line["occasion"] for line in lines if line["event"] not in ("started", "begun")]
    assert done == [occasion(0).id, SECOND]


def attempts(folder: Path) -> int:
    """How many attempts the campaign took in which something moved."""
    (run,) = _campaigns(folder)
    return len(RunDirectory.open(run).recordings)


def predicted(folder: Path, by: Path) -> FloatArray:
    """What the second version predicts on the first campaign of a folder."""
    model = Registry(folder / "registry").load("ur5", "v2")
    run = min(path.parent for path in by.glob("runs/*/*/*-campaign/start.json"))
    data = usable_part(load_source(run), model)
    return np.asarray(model.predict(data).effort)


def _campaigns(folder: Path) -> list[Path]:
    return [
        path.parent
        for path in folder.glob("runs/*/*/*-campaign/start.json")
        if SECOND in path.read_text("utf-8")
    ]
