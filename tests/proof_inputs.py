"""Print a hash of everything the long runs depend on; `make proof` keeps it in proof.lock.

CI says when this hash is no longer the one the long runs last passed with.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
LOCK = Path(__file__).with_name("proof.lock")
FOLDERS = ("hil", "mock_robot", "drivers", "benchmarks", "experiments", "examples")
FILES = (
    "pyproject.toml",
    "constraints.txt",
    "tests/test_proof.py",
    "tests/test_proof_docs.py",
    "tests/test_proof_drift_null.py",
    "tests/test_proof_example.py",
    "tests/test_proof_fleet.py",
    "tests/test_proof_fleet_mock.py",
    "tests/test_proof_identification.py",
    "tests/test_proof_inverse_dynamics.py",
    "tests/test_proof_kill_whole_runs.py",
    "tests/kill_whole_runs.py",
    "tests/test_proof_loads.py",
    "tests/test_proof_networks.py",
    "tests/test_proof_notebooks.py",
    "tests/test_proof_null_campaigns.py",
    "tests/test_proof_pipeline_kill.py",
    "tests/test_proof_recording.py",
    "tests/test_proof_schedule.py",
    "tests/test_proof_separation.py",
    "tests/test_proof_simulation.py",
    "tests/test_proof_ur.py",
    "tests/test_proof_wheels.py",
    "tests/test_proof_static.py",
    "tests/test_proof_stick_friction.py",
    "tests/test_trial_proof.py",
    "tests/test_fault_matrix.py",
    "tests/test_fault_matrix_ur.py",
    "tests/test_fault_matrix_can.py",
    "tests/test_campaign_weighing.py",
    "tests/test_bench_can.py",
    "tests/test_bench_excite.py",
    "tests/test_bench_lagrangian.py",
    "tests/test_bench_lm.py",
    "tests/test_robot_conformance.py",
    "tests/test_ur_conformance.py",
    "tests/test_ur_driver_connecting.py",
    "tests/test_ur_driver_runs.py",
    "tests/test_ur_driver_wire.py",
    "tests/test_ur_record_wire.py",
    "tests/test_twincat_runs.py",
    "tests/test_twincat_wire.py",
)


def inputs() -> list[Path]:
    """Everything in the folders of the code, and what the tests and their environment are."""
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    tests = [*(ROOT / "tests").glob("*.py"), *(ROOT / "tests" / "faults").glob("*.py")]
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
