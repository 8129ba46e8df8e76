"""Leases: one process per robot, freed by its death.

A lease is a file per robot in `$HIL_LEASES`, by default in a folder of this user's in `/tmp`, which
unlike `$XDG_RUNTIME_DIR` is the same one in a session, under cron and after logging out. It is
locked while held, says who holds it, and is touched every second (`hil.core.lock_file`).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shlex
import stat
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from hil.core import (
    Holder,
    LockFile,
    RobotConnectionError,
    SpecError,
    hold,
    holder_of,
)
from hil.robot.protocol import HasResource, Robot

SUFFIX = ".lease"
TRY_EVERY_S = 0.2


def resource_of(robot: Robot, *, name: str, driver: str, station: str) -> str:
    """What no two processes may drive at once; empty for a robot that is private to its process.

    Args:
        robot: Need not be connected.
        name: Of the robot in its station.
        driver: Name of its driver.
        station: The station's file, or what it is called.

    Raises:
        SpecError: The station is named as a file that is not there.
    """
    if isinstance(robot, HasResource):
        return robot.resource
    if robot.capabilities.clock == "virtual":
        return ""
    return f"{driver}:{name}@{_same_everywhere(station)}"


def _same_everywhere(station: str) -> str:
    """The station's file by its whole path, from whatever folder it was named."""
    file = Path(station)
    if file.is_file() or file.is_absolute():
        return str(file.resolve())
    if file.suffix in (".yaml", ".yml"):
        # By its bare name it would be another station than the one it is in its own folder.
        raise SpecError(
            f"there is no station file {station} in {Path.cwd()}",
            hint="give its whole path, such as Path(__file__).with_name('bench.yaml')",
        )
    return station


def leases_folder() -> Path:
    """Where leases are kept: `$HIL_LEASES`, or `hil-<user id>` in the system's folder for such."""
    if named := os.environ.get("HIL_LEASES"):
        return Path(named)
    # Not $TMPDIR: processes that are to see each other's leases may have different ones.
    system = Path("/tmp") if os.name == "posix" else Path(tempfile.gettempdir())  # noqa: S108
    return system / f"hil-{os.getuid()}"


def lease_path(resource: str) -> Path:
    """The file of a resource; its name is readable, and another one for every resource."""
    readable = re.sub(r"[^a-z0-9.]+", "-", resource.lower()).strip("-.")[:48]
    digest = hashlib.sha256(resource.encode()).hexdigest()[:8]
    return leases_folder() / f"{readable}-{digest}{SUFFIX}"


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to drive one robot, held by this process.

    Attributes:
        resource: What is held; empty for a robot that needs no lease.
        file: The file held for it.
    """

    resource: str
    file: LockFile | None = None

    def note_run(self, run: Path) -> None:
        """Let others see which run the robot is busy with."""
        if self.file is not None:
            with contextlib.suppress(OSError):  # it is for people to read, and no reason to stop
                self.file.update(run=str(run.resolve()))

    def release(self) -> None:
        """Let the robot go. Idempotent."""
        if self.file is not None:
            self.file.release()

    def __enter__(self) -> Lease:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()


def leased(
    robot: Robot,
    *,
    name: str,
    driver: str,
    station: str,
    wait_s: float = 0.0,
    tell: Callable[[str], object] = lambda text: None,
) -> Lease:
    """Take the lease of a robot; a context manager that lets it go.

    Args:
        robot: Need not be connected.
        name: Of the robot in its station.
        driver: Name of its driver.
        station: The station's file, or what it is called.
        wait_s: How long to wait for somebody else to let it go [s].
        tell: Is told once who is waited for.

    Raises:
        RobotConnectionError: Another process holds the robot, or leases cannot be kept.
        SpecError: See `resource_of`.
    """
    resource = resource_of(robot, name=name, driver=driver, station=station)
    if not resource:
        return Lease("")
    about = {"resource": resource, "robot": name, "driver": driver, "station": station, "run": ""}
    deadline, told = time.monotonic() + wait_s, False
    while isinstance(taken := _take(resource, about), Holder):
        held = f"robot {name} is held by {taken}"
        if time.monotonic() >= deadline:
            waited = f", still after {wait_s:g} s" if wait_s else ""
            raise RobotConnectionError(held + waited, hint=_who_and_what(station, wait_s))
        if not told:
            tell(f"{held}; waiting up to {wait_s:g} s")
            told = True
        time.sleep(TRY_EVERY_S)
    return Lease(resource, taken)


def _who_and_what(station: str, waited_s: float) -> str:
    """What to do about a held robot; without its station `hil robots` lists the built-in bench."""
    file = f" --station {shlex.quote(station)}" if Path(station).is_file() else ""
    wait = "" if waited_s else "; wait until it is let go: hil run … --wait 600"
    return f"who holds what: hil robots{file}{wait}"


def held_leases() -> list[Holder]:
    """Everything that is held by processes whose leases are kept in the same folder."""
    try:
        files = sorted(leases_folder().glob(f"*{SUFFIX}"))
    except OSError:
        return []
    return [holder for file in files if (holder := holder_of(file)) is not None]


def lease_holder(resource: str) -> Holder | None:
    """Who holds a resource, None when nobody does."""
    return holder_of(lease_path(resource))


def _take(resource: str, about: dict[str, str]) -> LockFile | Holder:
    try:
        _make_folder()
        return hold(lease_path(resource), about, shared=_is_shared())
    except OSError as error:
        raise RobotConnectionError(
            f"cannot keep a lease in {leases_folder()}: {error.strerror or error}",
            hint="give a folder that may be written to: HIL_LEASES=FOLDER",
        ) from error


def _is_shared() -> bool:
    return bool(os.environ.get("HIL_LEASES"))


def _make_folder() -> None:
    folder = leases_folder()
    if _is_shared():
        folder.mkdir(parents=True, exist_ok=True)
        return
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    # Anybody may make a folder of that name; leases are kept in none but our own.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise PermissionError("it belongs to somebody else")
    folder.chmod(0o700)
