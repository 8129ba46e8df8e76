"""Extras that the fits and studies of an experiment need after its motion; asked before it."""

from __future__ import annotations

from hil.core import Named, missing, require_installed
from hil.estimators import estimator
from hil.spec import ExperimentSpec
from hil.studies import study


def require_extras(spec: ExperimentSpec) -> None:
    """Refuse an experiment that could be measured here, but not evaluated.

    Raises:
        PluginError: An extra is missing; all are in the message.
        SpecError: A fit or study has a parameter that it does not take any more.
    """
    require_installed(_made(spec))


def missing_extras(spec: ExperimentSpec) -> list[str]:
    """What `require_extras` would refuse, in words: another computer may have what is missing."""
    return [f'{told} → pip install "hil[{extra}]"' for told, extra in missing(_made(spec))]


def _made(spec: ExperimentSpec) -> list[Named]:
    return [
        *(
            (f"fit: {fit.estimator}", estimator(fit.estimator, **fit.parameters))
            for fit in spec.fit
        ),
        *((f"study: {one.study}", study(one.study, **one.parameters)) for one in spec.study),
    ]
