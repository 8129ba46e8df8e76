"""Extras that the fits and studies of an experiment need after its motion; asked before it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hil import plugins
from hil.errors import PluginError
from hil.identify.base import estimator
from hil.spec.experiment import ExperimentSpec
from hil.study.base import study


def require_extras(spec: ExperimentSpec) -> None:
    """Refuse an experiment that could be measured here, but not evaluated.

    Raises:
        PluginError: An extra is missing; all are in the message.
        SpecError: A fit or study has a parameter that it does not take any more.
    """
    missing = dict(_missing(spec))
    if missing:
        extras = ",".join(dict.fromkeys(missing.values()))
        raise PluginError("\n".join(missing), hint=f'pip install "hil[{extras}]"')


def missing_extras(spec: ExperimentSpec) -> list[str]:
    """What `require_extras` would refuse, in words: another computer may have what is missing."""
    return [f'{told} → pip install "hil[{extra}]"' for told, extra in _missing(spec)]


def _missing(spec: ExperimentSpec) -> Iterator[tuple[str, str]]:
    """What lacks something, in words, and the extra that brings it."""
    made: list[tuple[str, Any]] = [
        (f"fit: {fit.estimator}", estimator(fit.estimator, **fit.parameters)) for fit in spec.fit
    ]
    made += [(f"study: {one.study}", study(one.study, **one.parameters)) for one in spec.study]
    for name, wanted in made:
        # Plug-ins need not inherit from ours.
        extras: dict[str, str] = dict(getattr(wanted, "extras", dict)())
        for extra, purpose in extras.items():
            if absent := plugins.absent_modules(extra):
                modules = " and ".join(absent)
                yield f"{name} needs {modules}, which is not installed, {purpose}", extra
