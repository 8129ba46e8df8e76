"""Shell completion: which words `hil.cli.candidates` finds for which parameter of which command.

Typer asks for them when a shell calls `hil` with `_HIL_COMPLETE`; only then `attach` is called, so
that no other command pays for it.
"""

import inspect
from collections.abc import Callable, Iterator
from copy import copy
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ParameterInfo

from hil.cli import candidates
from hil.export import TARGETS

Find = Callable[[candidates.Given, str], list[str]]


def _plugins(group: str, *also: str) -> Find:
    def find(given: candidates.Given, begun: str) -> list[str]:
        return [w for w in also if w.startswith(begun)] + candidates.plugins(group, begun)

    return find


def _words(*known: str) -> Find:
    return lambda given, begun: [word for word in known if word.startswith(begun)]


BY_NAME: dict[str, Find] = {
    "run": candidates.runs,
    "sources": candidates.runs,
    "source": candidates.runs,
    "validate": candidates.runs,
    "bare": candidates.runs,
    "data": candidates.runs,
    "probes": candidates.runs,
    "model": candidates.models,
    "spec": candidates.specs,
    "station": candidates.stations,
    "robot": candidates.robots,
    "robots": candidates.robots,
    "estimator": _plugins("hil.estimators"),
    "map_": candidates.maps,
    "version": candidates.versions,
    "against": candidates.versions,
    "word": _words("yes", "no"),
}
"""Of a parameter, whatever the command."""

BY_COMMAND: dict[tuple[str, str], Find] = {
    ("export", "to"): _words(*TARGETS),
    ("figures", "formats"): _words("pdf", "svg", "png"),
    ("figures", "width"): _words("column", "page"),
    ("study", "name"): _plugins("hil.studies"),
    ("bench", "name"): candidates.benchmarks,
    ("mock", "name"): _plugins("hil.mocks", "list"),
    ("mock", "model"): candidates.arms,
    ("mock", "profile"): _words("full", "ideal"),
    ("fit", "robot"): candidates.arms,
    ("gains", "robot"): candidates.arms,
    ("gains", "method"): _words("auto", "known-loads", "controller"),
    ("payload", "friction"): _words("auto", "model", "offset", "scale"),
    ("report", "run"): candidates.reported,
    ("new", "robot"): candidates.arms,
    ("drift", "name"): candidates.registered,
    ("run", "spec"): candidates.motions,
    ("plan", "spec"): candidates.motions,
    ("excite", "spec"): candidates.motions,
    ("fleet run", "spec"): candidates.motions,
    ("reidentify", "schedule"): candidates.schedules,
    ("record", "until"): _words("program-stops"),
    ("models register", "name"): candidates.registered,
    ("models show", "name"): candidates.registered,
    ("models compare", "name"): candidates.registered,
    ("models promote", "name"): candidates.registered,
    ("models promote", "on"): candidates.runs,
    ("models rollback", "name"): candidates.registered,
    ("models rollback", "to"): candidates.versions,
    ("models log", "name"): candidates.registered,
    **{
        (f"schedule {verb}", "file"): candidates.schedules
        for verb in ("run", "arm", "plan", "show", "simulate", "hold", "release", "systemd")
    },
}
"""Of a parameter of one command, before `BY_NAME`."""


def attach(app: typer.Typer) -> None:
    """Give every parameter that words are known for its completion.

    Args:
        app: With all its commands.
    """
    for verb, callback in commands(app):
        hints = get_type_hints(callback, include_extras=True)
        for name, hint in hints.items():
            find = BY_COMMAND.get((verb, name), BY_NAME.get(name))
            if find is not None and get_origin(hint) is Annotated:
                hints[name] = _with(find, hint)
        # typer reads the signature; the annotation itself may be shared with other commands.
        signature = inspect.signature(callback)
        vars(callback)["__signature__"] = signature.replace(
            parameters=[
                option.replace(annotation=hints[option.name])
                for option in signature.parameters.values()
            ]
        )


def _with(find: Find, hint: Any) -> Any:
    """The annotation with its completion, in a copy: several commands may share one."""
    of, *told = get_args(hint)
    told = [copy(info) if isinstance(info, ParameterInfo) else info for info in told]
    for info in told:
        if isinstance(info, ParameterInfo):
            info.autocompletion = _quietly(find)
    return Annotated.__class_getitem__((of, *told))  # type: ignore[attr-defined]


def commands(app: typer.Typer, before: str = "") -> Iterator[tuple[str, Callable[..., Any]]]:
    """Every command with its words, such as `models show`."""
    for command in app.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__.replace("_", "-")
        yield f"{before}{name}", command.callback
    for group in app.registered_groups:
        assert group.typer_instance is not None
        yield from commands(group.typer_instance, f"{before}{group.name} ")


def _quietly(find: Find) -> Callable[..., list[str]]:
    """As typer calls it; it goes by the annotations of what it is given."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        try:
            return find(context.params, incomplete)
        except Exception:  # a shell that waits for words must never see a traceback
            return []

    return complete
