"""Who writes which input: RTDE lets only one client at a time have a variable."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Client(Protocol):
    """An owner that is a connection."""

    def hang_up(self) -> None:
        """End it."""


class Ownership:
    """Inputs and those who have them; a fieldbus that occupies some is an owner like any other."""

    def __init__(self) -> None:
        self._owners: dict[str, object] = {}

    @property
    def clients(self) -> list[Client]:
        """Owners that are connections, each once."""
        return [who for who in dict.fromkeys(self._owners.values()) if isinstance(who, Client)]

    def free(self, name: str, owner: object) -> bool:
        """Whether this owner has it or may have it."""
        return self._owners.get(name, owner) is owner

    def take(self, names: Iterable[str], owner: object) -> bool:
        """Have all of them, or none if one is somebody else's."""
        names = list(names)
        if not all(self.free(name, owner) for name in names):
            return False
        self._owners.update(dict.fromkeys(names, owner))
        return True

    def release(self, owner: object) -> None:
        """Let go of everything that is this owner's."""
        self._owners = {name: who for name, who in self._owners.items() if who is not owner}

    def of(self, owner: object) -> list[str]:
        """Names of what is this owner's."""
        return [name for name, who in self._owners.items() if who is owner]
