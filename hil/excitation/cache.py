"""Cache of computed trajectories under a hash of all inputs of the computation.

Each request for trajectories has one JSON file in the cache. The JSON file of a request is
rewritten after each computed trajectory. An interrupted computation therefore resumes with the
first missing trajectory. A request for more trajectories than the file contains computes only the
missing trajectories.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import HilError, RecordingError, json_document, read_json, write_replacing
from hil.excitation.motion import FourierSeries, motion_from_dict

FORMAT = 1
OFF = "off"


class DamagedEntry(Exception):
    """Cache entry that exists but cannot be read or is invalid."""


@dataclass(frozen=True, slots=True)
class ExcitationCache:
    """Folder of cached trajectories.

    Attributes:
        folder: Folder of the cache; None to disable the cache.
        fresh: Flag; if true, existing entries are ignored and replaced.
    """

    folder: Path | None = None
    fresh: bool = False

    def read(self, key: str) -> tuple[FourierSeries, ...]:
        """Return the trajectories stored under `key`, or an empty tuple if there are none.

        Raises:
            DamagedEntry: The cache entry exists, but its content is damaged.
        """
        file = self.file(key)
        if file is None or self.fresh or not file.is_file():
            return ()
        try:
            return _series_of(read_json(file), key)
        except (HilError, KeyError, TypeError, ValueError) as error:
            raise DamagedEntry(f"{file} is damaged: {error}") from None

    def write(self, key: str, series: Sequence[FourierSeries]) -> None:
        """Store `series` under `key` atomically.

        Raises:
            RecordingError: The folder cannot be created or the file cannot be written.
        """
        if (file := self.file(key)) is None:
            return
        motions = [motion.to_dict() for motion in series]
        document = {"hil_excitation": FORMAT, "key": key, "sha256": digest(motions)}
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(
                f"cannot create {file.parent}: {error.strerror or error}",
                hint="set another folder (HIL_CACHE=DIR) or disable the cache (HIL_CACHE=off)",
            ) from error
        write_replacing(file, json_document(document | {"trajectories": motions}))

    def file(self, key: str) -> Path | None:
        """Return the path of the file of a cache entry, or None if the cache is disabled."""
        return None if self.folder is None else self.folder / f"{key[:32]}.json"


def user_cache(*, fresh: bool = False) -> ExcitationCache:
    """Return the cache of the current user.

    The cache is in `$HIL_CACHE` or in the cache folder of the operating system. `HIL_CACHE=off`
    disables the cache.
    """
    named = os.environ.get("HIL_CACHE", "")
    if named == OFF:
        return ExcitationCache()
    try:
        folder = Path(named) if named else _platform_folder()
    except RuntimeError:  # the user has no home folder
        return ExcitationCache()
    return ExcitationCache(folder / "excitation", fresh)


def digest(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """Return the SHA-256 of a JSON value, independent of the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _series_of(document: Mapping[str, Any], key: str) -> tuple[FourierSeries, ...]:
    motions = document["trajectories"]
    if document["hil_excitation"] != FORMAT or document["key"] != key:
        raise ValueError("it belongs to another version of hil or to another problem")
    if document["sha256"] != digest(motions):
        raise ValueError("its content does not match its digest")
    series = tuple(map(motion_from_dict, motions))
    if not all(isinstance(motion, FourierSeries) for motion in series):
        raise ValueError("it contains a motion that is not a Fourier series")
    return series  # type: ignore[return-value]


def _platform_folder() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "hil"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "hil"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hil"
