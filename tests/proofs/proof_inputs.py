"""Print a hash of everything the long runs depend on; `make proof` keeps it in proof.lock.

CI says when this hash is no longer the one the long runs last passed with.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

from tests.support.paths import ROOT

LOCK = Path(__file__).with_name("proof.lock")
FOLDERS = ("hil", "mock_robot", "drivers", "benchmarks", "experiments", "examples")
FILES = (
    "pyproject.toml",
    "constraints.txt",
    "tests/proofs/test_mock.py",
    "tests/proofs/test_docs.py",
    "tests/proofs/test_drift_null.py",
    "tests/proofs/test_example.py",
    "tests/proofs/test_fleet.py",
    "tests/proofs/test_fleet_mock.py",
    "tests/proofs/test_identification.py",
    "tests/proofs/test_inverse_dynamics.py",
    "tests/proofs/test_kill_whole_runs.py",
    "tests/proofs/kill_whole_runs.py",
    "tests/proofs/test_loads.py",
    "tests/proofs/test_networks.py",
    "tests/proofs/test_notebooks.py",
    "tests/proofs/test_null_campaigns.py",
    "tests/proofs/test_pipeline_kill.py",
    "tests/proofs/test_recording.py",
    "tests/proofs/test_schedule.py",
    "tests/proofs/test_separation.py",
    "tests/proofs/test_simulation.py",
    "tests/proofs/test_ur.py",
    "tests/proofs/test_wheels.py",
    "tests/proofs/test_static.py",
    "tests/proofs/test_stick_friction.py",
    "tests/proofs/test_hand_guiding.py",
    "tests/faults/test_embedded.py",
    "tests/faults/test_ur.py",
    "tests/faults/test_can.py",
    "tests/workflow/test_weighing.py",
    "tests/bench/test_can.py",
    "tests/bench/test_excite.py",
    "tests/bench/test_lagrangian.py",
    "tests/bench/test_lm.py",
    "tests/robot/test_conformance.py",
    "tests/drivers/ur/test_conformance.py",
    "tests/drivers/ur/test_connecting.py",
    "tests/drivers/ur/test_runs.py",
    "tests/drivers/ur/test_wire.py",
    "tests/drivers/ur/test_record_wire.py",
    "tests/drivers/twincat/test_runs.py",
    "tests/drivers/twincat/test_wire.py",
)


def inputs() -> list[Path]:
    """Everything in the folders of the code, and what the tests and their environment are."""
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    folders = ("support", "faults", "proofs")
    tests = [path for name in folders for path in (ROOT / "tests" / name).rglob("*.py")]
    helpers = [path for path in tests if not path.match("test_*")]
    found += [*helpers, *(ROOT / name for name in FILES)]
    return sorted(path for path in found if path.is_file() and "__pycache__" not in path.parts)


def inputs_hash() -> str:
    """SHA-256 over the names and contents of the inputs."""
    digest = hashlib.sha256()
    for path in inputs():
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def main() -> int:
    """`--keep` writes the lock, `--check` exits 1 when it is out of date."""
    if "--keep" in sys.argv:
        LOCK.write_text(inputs_hash() + "\n", "utf-8")
        return 0
    kept = LOCK.read_text("utf-8").strip() if LOCK.is_file() else ""
    return int("--check" in sys.argv and kept != inputs_hash())


if __name__ == "__main__":
    sys.exit(main())
