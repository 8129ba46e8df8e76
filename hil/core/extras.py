"""Extras of this distribution that a fit or study needs: asked for before anything is done."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from hil.core import plugins
from hil.core.errors import PluginError

Named = tuple[str, Any]
"""What somebody asked for in words, and the estimator or study that was made of it."""


def require_installed(made: Iterable[Named]) -> None:
    """Refuse what could be begun here, but not be finished.

    Raises:
        PluginError: Extras are missing; all are in the message, and in one command in the hint.
    """
    absent = dict(missing(made))
    if absent:
        extras = ",".join(dict.fromkeys(absent.values()))
        raise PluginError("\n".join(absent), hint=f'pip install "hil[{extras}]"')


def missing(made: Iterable[Named]) -> Iterator[tuple[str, str]]:
    """What lacks something, in words, and the extra that brings it."""
    for name, wanted in made:
        # Plug-ins need not inherit from ours.
        extras: dict[str, str] = dict(getattr(wanted, "extras", dict)())
        for extra, purpose in extras.items():
            if absent := plugins.absent_modules(extra):
                yield f"{plugins.lacking(name, absent)}, {purpose}", extra
