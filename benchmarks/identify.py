"""Identification on recorded robots: every method side by side, on data none of them has seen.

On the UR10e every method learns from four trajectories and is judged on another one; a load is
found in one half of a recording and tested on the other; on four more robots the default is set
against the classical methods on the later part of a recording. The classical methods share filters
and smoothing of signs; the default chooses filters of its own, and each side is shown with the
other's on the UR10e. Recordings are not part of the project: what is absent is left out.
"""

from __future__ import annotations

from typing import Any

from benchmarks.identification import loaded, makes, ur10e


def run(quick: bool = False) -> dict[str, Any]:
    """All tables.

    Args:
        quick: Few methods on little data, for tests.
    """
    sections = [part.measure(quick=quick) for part in (ur10e, loaded, makes)]
    document: dict[str, Any] = {"name": "identify"}
    document["tables"] = [table.to_dict() for section in sections for table in section.tables]
    for part in ("figures", "ratios", "skipped"):
        document[part] = {
            key: value for section in sections for key, value in getattr(section, part).items()
        }
    return document


if __name__ == "__main__":
    print(run())
