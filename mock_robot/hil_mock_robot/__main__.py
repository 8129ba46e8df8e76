"""Command `python -m hil_mock_robot NAME …`, which runs a mock robot as a separate process."""

from __future__ import annotations

import sys
from importlib import import_module

MOCKS = {
    "ur": "hil_mock_robot.ur.mock",
    "can": "hil_mock_robot.cia402.mock",
    "plc": "hil_mock_robot.twincat.mock",
}


def main() -> int:
    """Run the mock named by the first argument."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in MOCKS:
        return int(import_module(MOCKS[name]).main(sys.argv[2:]))
    print(f"usage: python -m hil_mock_robot {'|'.join(MOCKS)} [--help]", file=sys.stderr)  # noqa: T201
    return 2


if __name__ == "__main__":
    sys.exit(main())
