"""Plug-ins by entry point: names cost nothing, code is imported only when it is asked for.

A group such as `hil.estimators` maps names people write in a YAML file to `module:attribute`.
What is broken is an error when it is named, and a line in `describe_all` otherwise.

Optional libraries come as extras of this distribution. `not_installed` is the error of a library
that is missing; `require_installed` looks for all that some fits and studies need before a motion
or a fit begins.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points, packages_distributions
from importlib.util import find_spec
from typing import Any

from hil.core.errors import PluginError
from hil.core.suggest import closest, did_you_mean

GROUPS = {
    "hil.drivers": "robot driver",
    "hil.mocks": "mock robot",
    "hil.excitations": "excitation",
    "hil.estimators": "estimator",
    "hil.studies": "study",
    "hil.checks": "preflight check",
    "hil.interlocks": "interlock",
}
"""What each entry-point group holds, in words."""

NAMED_BY = {"hil.estimators": "estimator"}
"""Attribute of the classes of a group that is the name in model files: the entry point's."""

EXTRA_OF_MODULE = {
    "mujoco": "mock",
    "numba": "mock",
    "rtde_control": "ur",
    "rtde_receive": "ur",
    "rtde_io": "ur",
    "can": "can",
    "canopen": "can",
    "pyads": "ads",
    "torch": "learn",
    "distributed": "fleet",
    "rosbags": "bags",
    "foxglove": "live",
    "starlette": "web",
    "uvicorn": "web",
    "sse_starlette": "web",
    "cvxpy": "identify",
}
"""The extra of this distribution that brings an optional top-level module."""


@dataclass(frozen=True, slots=True)
class PluginInfo:
    """One registered plug-in, as `hil plugins` and `hil doctor` show it.

    Attributes:
        group, name: Where it is registered and under which name.
        target: `module:attribute` it stands for.
        distribution: Distribution and version that registered it, e.g. `hil 0.1.0`.
        error: Why it cannot be used; empty when it loads (or was not tried).
        hint: How to mend that.
    """

    group: str
    name: str
    target: str
    distribution: str
    error: str = ""
    hint: str = ""


def names(group: str) -> tuple[str, ...]:
    """Names registered in a group, sorted; nothing is imported."""
    return tuple(sorted({point.name for point in _registered(group)}))


def _registered(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, in order of their names."""
    return _read(entry_points, group, tuple(map(_changed_at, sys.path)))


@lru_cache(maxsize=64)
def _read(
    source: Callable[..., Iterable[EntryPoint]], group: str, path: tuple[tuple[str, int], ...]
) -> tuple[EntryPoint, ...]:
    """Read a group again only when `path`, the folders with packages, changes: it takes 20 ms."""
    return tuple(sorted(source(group=group), key=lambda point: (point.name, point.value)))


def _changed_at(folder: str) -> tuple[str, int]:
    try:
        return folder, os.stat(folder or ".").st_mtime_ns
    except OSError:
        return folder, 0


def load(group: str, name: str) -> Any:
    """Import the plug-in called `name`.

    Raises:
        PluginError: No plug-in has that name, two distributions claim it, its import fails (the
            cause is in the message and in `__cause__`), or its class has another name.
    """
    return load_point(find(group, name))


def load_point(point: EntryPoint) -> Any:
    """Import what an entry point names.

    Raises:
        PluginError: Its import fails (the cause is in the message and in `__cause__`), or it is a
            class that has another name than the entry point.
    """
    try:
        loaded = point.load()
    # A plug-in that calls sys.exit while it is imported must not end the whole program.
    except (Exception, SystemExit) as error:
        kind = _kind(point.group)
        missing = str(error.name) if isinstance(error, ModuleNotFoundError) else ""
        if extra := EXTRA_OF_MODULE.get(missing):
            raise not_installed(f"the {kind} {point.name!r}", [missing], extra) from error
        message = f"the {kind} {point.name!r} ({point.value}) does not load: {_cause(error)}"
        raise PluginError(message, hint=_remedy(error, point)) from error
    _require_name(point, loaded)
    return loaded


def _require_name(point: EntryPoint, loaded: Any) -> None:
    """Refuse a class whose results nobody could load again: they name the class by itself."""
    attribute = NAMED_BY.get(point.group)
    if attribute is None or not isinstance(loaded, type):
        return
    name = getattr(loaded, attribute, "")
    if name != point.name:
        raise PluginError(
            f"{loaded.__name__}.{attribute} is {name!r}, "
            f"but its entry point is called {point.name!r}",
            hint=f'set {attribute} = "{point.name}" in the class',
        )


def _kind(group: str) -> str:
    return GROUPS.get(group, f"{group} plug-in")


def _cause(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _remedy(error: BaseException, point: EntryPoint) -> str:
    for missing in _missing_modules(error):
        if extra := EXTRA_OF_MODULE.get(missing):
            return f'pip install "hil[{extra}]"'
        if missing == point.module.partition(".")[0]:
            return f"{_distribution(point)} is installed incompletely: install it again"
        return f"the module {missing!r} is missing: pip install the package that brings it"
    return f"mend or uninstall {_distribution(point)}; `hil doctor` shows all plug-ins"


def _missing_modules(error: BaseException) -> Iterator[str]:
    """Top-level modules that could not be found, along the chain of causes."""
    step: BaseException | None = error
    while step is not None:
        if isinstance(step, ModuleNotFoundError) and step.name:
            yield step.name.partition(".")[0]
        step = step.__cause__ or step.__context__


def _distribution(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unknown distribution"


def find(group: str, name: str) -> EntryPoint:
    """The entry point called `name`, without importing it.

    Raises:
        PluginError: No plug-in has that name, or two distributions claim it.
    """
    points = [point for point in _registered(group) if point.name == name]
    if not points:
        known = names(group)
        hint = did_you_mean(name, known) if known else "is hil installed, or just on the path?"
        if closest(name, known) is None:
            hint += "; one of your own is there once its package is installed again"
        raise PluginError(f"there is no {_kind(group)} called {name!r}", hint=hint)
    if len({point.value for point in points}) > 1:
        claims = " and ".join(f"{_distribution(p)} ({p.value})" for p in points)
        raise PluginError(
            f"the {_kind(group)} {name!r} is claimed by {claims}", hint="uninstall one of them"
        )
    return points[0]


def absent_modules(extra: str) -> tuple[str, ...]:
    """Top-level modules that an extra of this distribution brings and that are not installed."""
    brought = (module for module, of in EXTRA_OF_MODULE.items() if of == extra)
    return tuple(module for module in brought if find_spec(module) is None)


def not_installed(
    who: str, modules: Iterable[str], *extras: str, purpose: str = "", otherwise: str = ""
) -> PluginError:
    """Return the error of an extra that is missing.

    Args:
        who: Needs the modules.
        modules: Those that are missing; one at least.
        extras: Of this distribution, that bring them.
        purpose: What they are for, such as `to train`.
        otherwise: What else can be done.
    """
    hint = f'pip install "hil[{",".join(extras)}]"' + (f", or {otherwise}" if otherwise else "")
    return PluginError(lacking(who, modules) + (f", {purpose}" if purpose else ""), hint=hint)


def lacking(who: str, modules: Iterable[str]) -> str:
    """`the dashboard needs starlette and uvicorn, which are not installed`."""
    *most, last = modules
    told = f"{', '.join(most)} and {last}" if most else last
    return f"{who} needs {told}, which {'are' if most else 'is'} not installed"


Named = tuple[str, Any]
"""Words for a fit or study, and its estimator or study."""


def require_installed(made: Iterable[Named]) -> None:
    """Raise if a fit or study could be begun here, but not be finished.

    Raises:
        PluginError: Extras are missing; all are in the message, and in one command in the hint.
    """
    absent = dict(absent_extras(made))
    if absent:
        extras = ",".join(dict.fromkeys(absent.values()))
        raise PluginError("\n".join(absent), hint=f'pip install "hil[{extras}]"')


def absent_extras(made: Iterable[Named]) -> Iterator[tuple[str, str]]:
    """Yield what lacks a library, in words, and the extra that brings it."""
    for name, one in made:
        # Plug-ins need not inherit from ours.
        extras: dict[str, str] = dict(getattr(one, "extras", dict)())
        for extra, purpose in extras.items():
            if absent := absent_modules(extra):
                yield f"{lacking(name, absent)}, {purpose}", extra


def describe_all(*, try_loading: bool = True) -> tuple[PluginInfo, ...]:
    """Every registered plug-in with what is wrong with it; never raises.

    Args:
        try_loading: Import each plug-in to see whether it works, which takes seconds and memory.
    """
    return tuple(
        _describe(group, point, try_loading) for group in GROUPS for point in _registered(group)
    )


def _describe(group: str, point: EntryPoint, try_loading: bool) -> PluginInfo:
    info = (group, point.name, point.value, _distribution(point))
    if not try_loading:
        return PluginInfo(*info)
    try:
        load(group, point.name)
    except PluginError as error:
        return PluginInfo(*info, error.message, error.hint)
    return PluginInfo(*info)


def origin_of(thing: object) -> str:
    """Class and distribution that an object of a plug-in comes from, for messages."""
    kind = type(thing)
    name = f"{kind.__module__}.{kind.__qualname__}"
    owners = packages_distributions().get(kind.__module__.partition(".")[0], ())
    return f"{name} of {owners[0]}" if owners else name
