"""For tests of the UR driver: addresses of their own."""

from __future__ import annotations

import os


def own_address(last: int) -> str:
    """A loopback address that no other test process uses."""
    pid = os.getpid()
    return f"127.{1 + pid % 250}.{pid // 250 % 250}.{last}"
