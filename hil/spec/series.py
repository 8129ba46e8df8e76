"""Model of a series YAML file: experiments that are run in sequence."""

from __future__ import annotations

from pathlib import Path as FilePath

from pydantic import Field

from hil.core import KeyPath, Source, read_source
from hil.spec.field_types import FormatVersion, Name, RobotAddresses, Strict
from hil.spec.load import is_kind, make_absolute, refuse_other_kind, validated

KEY = "hil_series"


class SeriesEntry(Strict):
    """Experiment of a series."""

    spec: str = Field(
        description="Experiment (YAML); a relative path starts at the folder of the series."
    )
    station: str | None = Field(
        None,
        description="Station of this experiment; by default the station of the series, otherwise "
        "the station that `hil run` would choose.",
    )


class SeriesSpec(Strict):
    """Experiments in the order of execution, each an ordinary run."""

    hil_series: FormatVersion = Field(description="Version of the series format.")
    name: Name = Field(description="Name of the overview's folder; letters, digits, `_.-`.")
    description: str = Field("", description="Purpose of the series; shown in the overview.")
    station: str | None = Field(
        None, description="Station of all experiments that name no station."
    )
    robots: RobotAddresses = Field({})
    series: tuple[SeriesEntry, ...] = Field(
        min_length=1, description="Experiments in the order of execution."
    )


def is_series(file: str | FilePath | Source) -> bool:
    """Return whether a file, or its source, is a series; False if it is unreadable."""
    return is_kind(file, KEY)


def load_series_spec(file: str | FilePath | Source) -> SeriesSpec:
    """Read a series; check only that the files it names are experiments and stations.

    Args:
        file: YAML file of the series, or the source read from the file.

    Returns:
        Validated series, in which all paths are absolute.

    Raises:
        SpecError: The file has problems; the message has one line `file:line:column: path: message`
            per problem.
    """
    source = file if isinstance(file, Source) else read_source(file)
    folder = FilePath(source.name).parent
    refuse_other_kind(source, KEY)
    for place in _places(source):
        make_absolute(source, place, folder)
    return validated(source, SeriesSpec)


def _places(source: Source) -> list[KeyPath]:
    """Return the paths of the keys in a series that possibly name a file."""
    entries = source.at(("series",))
    count = len(entries) if isinstance(entries, list) else 0
    return [
        ("station",),
        *(("series", i, key) for i in range(count) for key in ("spec", "station")),
    ]
