"""`hil.plan` is a package and a function of the API; so are `evaluate`, `study` and `registry`.

Importing a subpackage binds it as an attribute of its parent, over the function of the same name.
So these packages are made callable: a call goes to the function in `hil.api`
(decision record 0011).
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class CallableModule(ModuleType):
    """A subpackage of `hil` that calls the API function of its own name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call `hil.api.<name>`; see there."""
        name = self.__name__.rpartition(".")[2]
        return getattr(import_module("hil.api"), name)(*args, **kwargs)


def make_callable(module_name: str) -> None:
    """Let the module call its API function; to be used at the end of its `__init__`."""
    sys.modules[module_name].__class__ = CallableModule
