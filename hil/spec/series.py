"""What a series YAML may say: experiments that are run one after the other."""

from __future__ import annotations

from pathlib import Path as FilePath

from pydantic import Field

from hil.core import KeyPath, Source, read_source
from hil.spec.field_types import FormatVersion, Name, RobotAddresses, Strict
from hil.spec.load import is_kind, make_absolute, refuse_other_kind, validated

KEY = "hil_series"


class SeriesEntry(Strict):
    """One experiment of a series."""

    spec: str = Field(
        description="The experiment (YAML); a relative path starts at the folder of the series."
    )
    station: str | None = Field(
        None,
        description="The station it runs at; by default that of the series, else the one it would "
        "run at by itself.",
    )


class SeriesSpec(Strict):
    """Experiments in the order they are run in, each an ordinary run."""

    hil_series: FormatVersion = Field(description="Version of the series format.")
    name: Name = Field(description="Names the folder of the overview; letters, digits, `_.-`.")
    description: str = Field("", description="What this is for; shown in the overview.")
    station: str | None = Field(
        None, description="The station of all experiments that name none themselves."
    )
    robots: RobotAddresses = Field({})
    series: tuple[SeriesEntry, ...] = Field(min_length=1, description="The experiments.")


def is_series(file: str | FilePath | Source) -> bool:
    """Return whether a file, or what was read from it, is a series; an unreadable one is none."""
    return is_kind(file, KEY)


def load_series_spec(file: str | FilePath | Source) -> SeriesSpec:
    """Read a series; what it names must be experiments and stations, and is not checked further.

    Args:
        file: The YAML file, or what was read from it.

    Returns:
        The series; its paths are absolute.

    Raises:
        SpecError: With a line `file:line:column: path: message` for every problem.
    """
    source = file if isinstance(file, Source) else read_source(file)
    folder = FilePath(source.name).parent
    refuse_other_kind(source, KEY)
    for place in _places(source):
        make_absolute(source, place, folder)
    return validated(source, SeriesSpec)


def _places(source: Source) -> list[KeyPath]:
    """Where a series may name a file."""
    entries = source.at(("series",))
    count = len(entries) if isinstance(entries, list) else 0
    return [
        ("station",),
        *(("series", i, key) for i in range(count) for key in ("spec", "station")),
    ]
