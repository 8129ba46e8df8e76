"""Files that another file names, such as the experiments of a series."""

from __future__ import annotations

from pathlib import Path as FilePath

from hil.core import KeyPath, Source, no_file_but
from hil.spec.checks import is_file
from hil.spec.load import no_such_kind


def make_absolute(source: Source, place: KeyPath, folder: FilePath) -> None:
    """Make a path absolute that starts at the folder of its file; note it if there is no such file.

    Args:
        source: Problems are added to it.
        place: Where the path is; its last key is `station`, or something that is an experiment.
        folder: Of the file.
    """
    named, holder = source.at(place), source.at(place[:-1])
    if not isinstance(named, str) or not isinstance(holder, dict):
        return
    file = folder / named
    if not is_file(file):
        source.add(place, no_file_but(file, (".yaml", ".yml")))
        return
    if wrong := no_such_kind(file, "hil_station" if place[-1] == "station" else "hil"):
        source.add(place, wrong)
    holder[place[-1]] = str(file.resolve())
