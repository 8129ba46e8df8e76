"""Plug-ins by entry point: names are listed without imports, and code is imported only on demand.

An entry-point group such as `hil.estimators` maps names in a YAML file to `module:attribute`. A
plug-in that cannot be imported raises an error if it is loaded by name; `describe_all` only lists
the error.

Optional libraries are installed by extras of this distribution. The function `not_installed`
returns the error for a missing library; `require_installed` checks all libraries that fits and
studies need, before a motion or a fit begins.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
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
"""Kind of plug-in by entry-point group, for messages."""

MEMBERS = {
    "hil.drivers": (
        "identity", "capabilities", "limits", "connect", "set_payload", "prepare", "start", "read",
        "stop", "close",
    ),
    "hil.excitations": ("program",),
    "hil.estimators": (
        "fit", "predict", "stream", "fitted_arrays", "fitted_facts", "restore", "parameter_names",
        "get_params",
    ),
    "hil.studies": ("run", "parameter_names"),
    "hil.interlocks": ("check", "clear"),
}  # fmt: skip
"""Members that the class of a plug-in must have, by entry-point group."""

NAMED_BY = {"hil.estimators": "estimator"}
"""Class attribute that must be equal to the entry-point name, as used in model files, by group."""

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
"""Name of the extra of this distribution that installs an optional library, by top-level module."""


@dataclass(frozen=True, slots=True)
class PluginInfo:
    """Registered plug-in, as shown by `hil plugins` and `hil doctor`.

    Attributes:
        group, name: Entry-point group of the plug-in, and name of the plug-in.
        target: Import path `module:attribute` of the plug-in.
        distribution: Name and version of the distribution that registers the plug-in, for example
            `hil 0.1.0`.
        error: Reason why the plug-in cannot be used; empty if the plug-in was loaded, or if loading
            was not tried.
        hint: Advice on how to repair the plug-in.
    """

    group: str
    name: str
    target: str
    distribution: str
    error: str = ""
    hint: str = ""


def names(group: str) -> tuple[str, ...]:
    """Return the sorted names registered in a group, without importing the plug-ins."""
    return tuple(sorted({point.name for point in _registered(group)}))


def _registered(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, sorted by name."""
    return _read(entry_points, group, tuple(map(_changed_at, sys.path)))


@lru_cache(maxsize=64)
def _read(
    source: Callable[..., Iterable[EntryPoint]], group: str, path: tuple[tuple[str, int], ...]
) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group; cached until `path`, the package folders, changes.

    Without the cache, reading the entry points takes 20 ms.
    """
    return tuple(sorted(source(group=group), key=lambda point: (point.name, point.value)))


def _changed_at(folder: str) -> tuple[str, int]:
    try:
        return folder, os.stat(folder or ".").st_mtime_ns
    except OSError:
        return folder, 0


def load(group: str, name: str) -> Any:
    """Import the plug-in called `name`, and return the imported object.

    Raises:
        PluginError: No plug-in has this name, two distributions register it, its import fails (the
            cause is in the message and in `__cause__`), or its class has a different name.
    """
    return load_point(find(group, name))


def load_point(point: EntryPoint) -> Any:
    """Import the object that an entry point names.

    Raises:
        PluginError: The import fails (the cause is in the message and in `__cause__`), or the
            object is a class with a different name than the entry point.
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
    _require_members(point, loaded)
    _require_name(point, loaded)
    return loaded


def _require_members(point: EntryPoint, loaded: Any) -> None:
    """Raise if the class of a plug-in lacks members that the interface of its group requires."""
    missing = [name for name in MEMBERS.get(point.group, ()) if not hasattr(loaded, name)]
    if missing and isinstance(loaded, type):
        kind = _kind(point.group)
        raise PluginError(
            f"the {kind} {point.name!r} ({point.value}) lacks {', '.join(missing)}",
            hint=f"add these members to {loaded.__name__}; `hil new` creates a complete template",
        )


def _require_name(point: EntryPoint, loaded: Any) -> None:
    """Raise if the name of a plug-in class differs from the name of its entry point.

    Results store the class name of their plug-in, so results of a class with a different name could
    not be loaded again.
    """
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
        return f"the module {missing!r} is missing: install the package that contains it"
    return f"repair or uninstall {_distribution(point)}; `hil doctor` shows all plug-ins"


def _missing_modules(error: BaseException) -> Iterator[str]:
    """Yield the top-level modules that were not found, along the chain of causes of an error."""
    step: BaseException | None = error
    while step is not None:
        if isinstance(step, ModuleNotFoundError) and step.name:
            yield step.name.partition(".")[0]
        step = step.__cause__ or step.__context__


def _distribution(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unknown distribution"


def find(group: str, name: str) -> EntryPoint:
    """Return the entry point called `name`, without importing the plug-in.

    Raises:
        PluginError: No plug-in has this name, or two distributions register it.
    """
    points = [point for point in _registered(group) if point.name == name]
    if not points:
        known = names(group)
        hint = (
            did_you_mean(name, known) if known else "is hil installed, or only on the Python path?"
        )
        if closest(name, known) is None:
            hint += "; after adding a plug-in to your package, install the package again"
        raise PluginError(f"there is no {_kind(group)} called {name!r}", hint=hint)
    if len({point.value for point in points}) > 1:
        claims = " and ".join(f"{_distribution(p)} ({p.value})" for p in points)
        raise PluginError(
            f"the {_kind(group)} {name!r} is registered by {claims}", hint="uninstall one of them"
        )
    return points[0]


def absent_modules(extra: str) -> tuple[str, ...]:
    """Return the top-level modules of an extra that are not installed."""
    brought = (module for module, of in EXTRA_OF_MODULE.items() if of == extra)
    return tuple(module for module in brought if find_spec(module) is None)


def not_installed(
    who: str, modules: Iterable[str], *extras: str, purpose: str = "", otherwise: str = ""
) -> PluginError:
    """Return the error to raise for a missing extra.

    Args:
        who: Name of the feature that needs the modules.
        modules: Names of the missing modules, at least one.
        extras: Names of the extras of this distribution that install the modules.
        purpose: Purpose for which the modules are needed, such as `to train`.
        otherwise: Alternative to installing the extra, for the hint.
    """
    hint = f'pip install "hil[{",".join(extras)}]"' + (f", or {otherwise}" if otherwise else "")
    return PluginError(lacking(who, modules) + (f", {purpose}" if purpose else ""), hint=hint)


def lacking(who: str, modules: Iterable[str]) -> str:
    """Return, for example, `the dashboard needs starlette and uvicorn, which are not installed`."""
    *most, last = modules
    listed = f"{', '.join(most)} and {last}" if most else last
    return f"{who} needs {listed}, which {'are' if most else 'is'} not installed"


Named = tuple[str, Any]
"""Label of a fit or study for messages, and its estimator or study."""


def require_installed(made: Iterable[Named]) -> None:
    """Raise if a fit or study needs extras that are not installed.

    Raises:
        PluginError: Extras are missing; the message lists all missing extras, and the hint is one
            command that installs them.
    """
    absent = dict(absent_extras(made))
    if absent:
        extras = ",".join(dict.fromkeys(absent.values()))
        raise PluginError("\n".join(absent), hint=f'pip install "hil[{extras}]"')


def absent_extras(made: Iterable[Named]) -> Iterator[tuple[str, str]]:
    """Yield a message for each missing library, and the name of the extra that installs it."""
    for name, one in made:
        # A plug-in need not inherit from our classes.
        extras: object = getattr(one, "extras", dict)()
        if not isinstance(extras, Mapping):
            raise PluginError(
                f"{origin_of(one)}: extras() returns {extras!r}, not a mapping",
                hint="return {} if no optional library is needed",
            )
        for extra, purpose in extras.items():
            if absent := absent_modules(extra):
                yield f"{lacking(name, absent)}, {purpose}", extra


def describe_all(*, try_loading: bool = True) -> tuple[PluginInfo, ...]:
    """Return every registered plug-in, with its error if it has one; never raises.

    Args:
        try_loading: Whether to import each plug-in as a test, which takes seconds and memory.
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
    """Return class name and distribution of an object from a plug-in, for messages."""
    kind = type(thing)
    name = f"{kind.__module__}.{kind.__qualname__}"
    owners = packages_distributions().get(kind.__module__.partition(".")[0], ())
    return f"{name} of {owners[0]}" if owners else name
