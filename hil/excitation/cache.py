"""Trajectories that took long to compute, kept under a hash of everything they depend on.

One JSON file per question. A list of trajectories grows while they are computed, so whoever is
interrupted goes on where it was, and asking for more of them computes only the new ones.
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
    """An entry that is there and cannot be used."""


@dataclass(frozen=True, slots=True)
class ExcitationCache:
    """Where trajectories are kept.

    Attributes:
        folder: None keeps nothing.
        fresh: What is there is not read, but replaced.
    """

    folder: Path | None = None
    fresh: bool = False

    def read(self, key: str) -> tuple[FourierSeries, ...]:
        """What is kept under `key`, nothing by default.

        Raises:
            DamagedEntry: Something is, and it is damaged.
        """
        file = self.file(key)
        if file is None or self.fresh or not file.is_file():
            return ()
        try:
            return _series_of(read_json(file), key)
        except (HilError, KeyError, TypeError, ValueError) as error:
            raise DamagedEntry(f"{file} is damaged: {error}") from None

    def write(self, key: str, series: Sequence[FourierSeries]) -> None:
        """Keep `series` under `key`, whole or not at all.

        Raises:
            RecordingError: The disk refuses.
        """
        if (file := self.file(key)) is None:
            return
        motions = [motion.to_dict() for motion in series]
        document = {"hil_excitation": FORMAT, "key": key, "sha256": digest(motions)}
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(
                f"cannot make {file.parent}: {error.strerror or error}",
                hint="name another folder: HIL_CACHE=DIR, or none: HIL_CACHE=off",
            ) from error
        write_replacing(file, json_document(document | {"trajectories": motions}))

    def file(self, key: str) -> Path | None:
        """The file of an entry, None where nothing is kept."""
        return None if self.folder is None else self.folder / f"{key[:32]}.json"


def user_cache(*, fresh: bool = False) -> ExcitationCache:
    """This user's: in `$HIL_CACHE` or where the system keeps caches; `HIL_CACHE=off` for none."""
    named = os.environ.get("HIL_CACHE", "")
    if named == OFF:
        return ExcitationCache()
    try:
        folder = Path(named) if named else _platform_folder()
    except RuntimeError:  # a user without a home
        return ExcitationCache()
    return ExcitationCache(folder / "excitation", fresh)


def digest(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """sha256 of a JSON value, whatever the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _series_of(document: Mapping[str, Any], key: str) -> tuple[FourierSeries, ...]:
    motions = document["trajectories"]
    if document["hil_excitation"] != FORMAT or document["key"] != key:
        raise ValueError("it is of another version or of another question")
    if document["sha256"] != digest(motions):
        raise ValueError("its content is not what was written")
    series = tuple(map(motion_from_dict, motions))
    if not all(isinstance(motion, FourierSeries) for motion in series):
        raise ValueError("it holds other motions than Fourier series")
    return series  # type: ignore[return-value]


def _platform_folder() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "hil"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "hil"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hil"
