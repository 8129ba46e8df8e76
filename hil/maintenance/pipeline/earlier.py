"""Probes of the weeks before: what a robot that has not changed is to be predicted on, too.

A comparison on one day is sure of that day. Another room, another noise, and the champion may be
the better one again: where a robot is as it was, both are compared on what it did before as well.
"""

from __future__ import annotations

from pathlib import Path

from hil.models import Registry, probes_of
from hil.recording import recordings_in

MOST = 5


def earlier_probes(registry: Registry, name: str, run: Path) -> list[Path]:
    """The last probes before one, as far back as nothing has changed; at most `MOST`.

    Args:
        registry: Where the history of probes is.
        name: Whose.
        run: The probe of now, which says that nothing has changed.

    Returns:
        Those whose recordings are still there, newest first.

    Raises:
        RegistryError: The history is damaged.
    """
    # One probe has a line for each champion that it was compared with.
    told = {one.uid: one for one in sorted(probes_of(registry, name), key=lambda one: one.changed)}
    found: list[Path] = []
    for probe in sorted(told.values(), key=lambda one: one.at, reverse=True):
        if probe.changed or len(found) == MOST:
            break
        source = Path(probe.source)
        if source.resolve() != run.resolve() and _is_there(source):
            found.append(source)
    return found


def _is_there(source: Path) -> bool:
    """Recordings are pruned, and runs moved away."""
    folder = source / "recording"
    return source.is_file() or (folder.is_dir() and bool(recordings_in(folder)))
