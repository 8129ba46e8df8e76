"""`python -m hil_mock_robot NAME …`: mock robots that are processes of their own."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the mock that the first argument names."""
    if sys.argv[1:2] == ["ur"]:
        from hil_mock_robot.ur.app import main as ur

        return ur(sys.argv[2:])
    print("usage: python -m hil_mock_robot ur [--help]", file=sys.stderr)  # noqa: T201
    return 2


if __name__ == "__main__":
    sys.exit(main())
