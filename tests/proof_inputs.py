"""Print a hash of everything the long runs depend on; `make proof` keeps it in proof.lock.

CI runs the long tests again only when this hash is no longer the one they last passed with.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
LOCK = Path(__file__).with_name("proof.lock")
INPUTS = (
    "hil/**/*.py", "hil/arms/*.yaml", "mock_robot/**/*.py", "mock_robot/**/*.yaml",
    "drivers/**/*.py", "benchmarks/*.py", "experiments/*.yaml", "constraints.txt",
    "tests/test_proof.py",
)  # fmt: skip


def inputs_hash() -> str:
    """SHA-256 over the names and contents of the inputs."""
    digest = hashlib.sha256()
    for path in sorted({path for pattern in INPUTS for path in ROOT.glob(pattern)}):
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
