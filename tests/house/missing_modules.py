"""Runs `hil` as where some modules are not installed: `python missing_modules.py A,B VERB …`."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

BLOCKED = sys.argv[1].split(",")


class Without(PathFinder):
    """Python's own search for modules, that does not find the blocked ones."""

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """As `PathFinder.find_spec`."""
        if name.partition(".")[0] in BLOCKED:
            return None
        return super().find_spec(name, path, target)


if __name__ == "__main__":
    sys.meta_path[sys.meta_path.index(PathFinder)] = Without
    from hil.cli import main

    sys.argv = ["hil", *sys.argv[2:]]
    main()
