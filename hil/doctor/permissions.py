"""Folders that are written to, and devices of the kernel."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from hil.doctor.finding import Finding
from hil.excitation import user_cache
from hil.robot import leases_folder

SERIAL = ("ttyUSB*", "ttyACM*")
"""Adapters below /dev that need the group `dialout`; CAN adapters by serial line are among them."""


def folders() -> Iterator[Finding]:
    """Whether runs, leases, models and cached trajectories can be written; nothing is made."""
    runs = Path(os.environ.get("HIL_RUNS") or "runs")
    registry = Path(os.environ.get("HIL_REGISTRY") or "registry")
    cache = user_cache().folder
    yield _writable("folder", Path(), "bad", "go to one of your own")
    yield _writable("runs", runs, "bad", "name another: --runs DIR or $HIL_RUNS")
    leases = leases_folder()
    if leases.is_dir() and not os.environ.get("HIL_LEASES") and not _is_mine(leases):
        text = f"{leases} belongs to somebody else; name another folder: $HIL_LEASES"
        yield Finding("leases", text, "bad")
    else:
        yield _writable("leases", leases, "bad", "name another for leases: $HIL_LEASES")
    yield _writable("registry", registry, "note", "name another: --registry DIR or $HIL_REGISTRY")
    if cache is not None:
        yield _writable("cache", cache, "note", "name another: $HIL_CACHE, or HIL_CACHE=off")


def serial(devices: Path = Path("/dev")) -> Iterator[Finding]:
    """Serial adapters that are there and may not be opened; nothing where there is none.

    Args:
        devices: Where they are.
    """
    found = sorted(path for pattern in SERIAL for path in devices.glob(pattern))
    closed = [path.name for path in found if not os.access(path, os.R_OK | os.W_OK)]
    if closed:
        mend = "sudo usermod -aG dialout $USER, then log in again"
        yield Finding("serial", f"{', '.join(closed)} may not be opened: {mend}", "note")
    elif found:
        yield Finding("serial", f"{', '.join(path.name for path in found)} may be opened")


def _writable(what: str, folder: Path, level: str, mend: str) -> Finding:
    """Whether a folder can be written to, or could be made."""
    above = folder.absolute()
    while not above.exists() and above != above.parent:
        above = above.parent
    fits = above.is_dir() and os.access(above, os.W_OK | os.X_OK)
    if not fits:
        reason = "is not writable" if above.is_dir() else "is no folder"
        return Finding(what, f"{above} {reason}; {mend}", level)
    made = folder.absolute() == above
    return Finding(what, "writable" if made else f"{folder} can be made")


def _is_mine(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        return folder.lstat().st_uid == os.getuid()
    return False
