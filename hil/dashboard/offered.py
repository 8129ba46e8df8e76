"""Specs and stations that are offered: files below the folder that `hil serve --specs` names."""

from __future__ import annotations

import os
import re
from functools import lru_cache
from itertools import islice
from pathlib import Path

from hil.core import SpecError, name_read, name_text
from hil.dashboard.settings import Settings

LOOKED_AT = 2000
"""Files below the folder; somebody may have named their home."""

MOST_BYTES = 1_000_000
_KIND = re.compile(rb"^(hil|hil_series|hil_station)\s*:", re.MULTILINE)
_WORDS = {b"hil": "experiment", b"hil_series": "series", b"hil_station": "station"}


def offered(settings: Settings, *kinds: str) -> list[str]:
    """Return the names of the files of some kinds (`experiment`, `series`, `station`).

    From the folder on, as text that a form can hold (`hil.core.text.name_text`).
    """
    if settings.specs is None:
        return []
    found = islice(_files(settings.specs), LOOKED_AT)
    return sorted(
        name_text(path.relative_to(settings.specs)) for path in found if _kind_in(path) in kinds
    )


def file_offered(name: str, settings: Settings, *kinds: str) -> Path:
    """The file of such a name.

    Raises:
        SpecError: None of that name is offered.
    """
    if settings.specs is None or name not in offered(settings, *kinds):
        raise SpecError(
            f"{name!r} is not offered here", hint=f"offered is what {settings.specs} has"
        )
    return settings.specs / name_read(name)


def _files(folder: Path) -> list[Path]:
    found = []
    for above, folders, names in os.walk(folder):
        if "start.json" in names:  # a run: its spec.yaml is what it was run with
            folders.clear()
            continue
        folders[:] = sorted(one for one in folders if not one.startswith("."))
        found += [Path(above) / name for name in sorted(names) if name.endswith((".yaml", ".yml"))]
        if len(found) >= LOOKED_AT:
            break
    return found


def _kind_in(path: Path) -> str:
    try:
        about = path.stat()
    except OSError:
        return ""
    return _kind(path, about.st_mtime_ns) if about.st_size < MOST_BYTES else ""


@lru_cache(maxsize=LOOKED_AT)
def _kind(path: Path, changed: int) -> str:
    """What a file says it is; read once per change."""
    try:
        found = _KIND.search(path.read_bytes())
    except OSError:
        return ""
    return _WORDS[found[1]] if found else ""
