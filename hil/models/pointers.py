"""Which registries came to know runs of a folder: noted there, for whoever deletes runs later.

`RUNS/.registries` has a registry a line, as JSON text, and only grows: a registry may be anywhere,
and a run that a model came from must not go because nobody has thought of naming it.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Iterable
from datetime import date
from pathlib import Path

from hil.core import RegistryError

FILE = ".registries"

_NOT_OURS = (errno.EROFS, errno.EACCES, errno.EPERM)


def leave_pointer(registry: Path, sources: Iterable[Path]) -> None:
    """Note a registry in the folders of runs that sources are of; others say nothing.

    A folder of runs that may not be written to is left as it is.

    Args:
        registry: Folder of the models.
        sources: Run directories, and files and folders in them.

    Raises:
        RegistryError: It cannot be noted.
    """
    line = json.dumps(str(registry.resolve())).encode() + b"\n"
    for file in {root / FILE for source in sources if (root := _runs_of(source))}:
        try:
            _add(file, line)
        except OSError as error:
            if error.errno not in _NOT_OURS:
                raise RegistryError(
                    f"cannot write {file}: {error.strerror or error}",
                    hint="see whether the folder may be written to and the disk has room",
                ) from error


def pointed(runs: Path) -> list[Path]:
    """Registries that are noted in a folder of runs.

    Raises:
        RegistryError: One of them is not there, or nobody can say which they are.
    """
    file = runs / FILE
    try:
        lines = file.read_bytes().splitlines()
        found = [Path(json.loads(line)) for line in lines if line.strip()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError) as error:
        raise RegistryError(
            f"{file} does not say which registries know runs of this folder: {error}",
            hint="a registry a line, in quotes; nothing is deleted before",
        ) from error
    for registry in found:
        _require_models(registry, file)
    return found


def _require_models(registry: Path, file: Path) -> None:
    """An empty folder is what is left of a disk that is not mounted."""
    with contextlib.suppress(OSError):
        if any(registry.glob("*/v[0-9]*")):
            return
    raise RegistryError(
        f"{file} names the registry {registry}, which is not there or has no models",
        hint="bring it back; or take that line out, and give where it is now with --registry",
    )


def _runs_of(source: Path) -> Path | None:
    """The folder of runs that a source is in, as `RUNS/DAY/ROBOT/RUN/…`."""
    whole = source.resolve()
    run = next((one for one in (whole, *whole.parents) if (one / "start.json").is_file()), None)
    if run is None or len(run.parents) < 3:
        return None
    with contextlib.suppress(ValueError):
        date.fromisoformat(run.parents[1].name)
        return run.parents[2]
    return None


def _add(file: Path, line: bytes) -> None:
    with file.open("ab+") as opened:
        opened.seek(0)
        if line in opened.readlines():
            return
        opened.write(line)  # to the end, whoever else writes
        opened.flush()
        os.fsync(opened.fileno())
