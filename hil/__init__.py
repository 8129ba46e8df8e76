"""hil: from one YAML file to a validated, deployed and maintained robot model.

>>> import hil
>>> experiment = hil.load("experiments/ci_dwell_12.yaml")   # doctest: +SKIP
>>> report = hil.run(experiment)                            # doctest: +SKIP

Importing this package loads no hardware library and no large library, because its functions are
imported from `hil.api` at their first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.api import (
        dataset,
        estimate_payload,
        evaluate,
        export_data,
        export_model,
        figures,
        fit,
        import_recording,
        load,
        plan,
        registry,
        reidentify,
        rest_poses,
        resume,
        run,
        simulate,
        study,
    )
    from hil.planning import Experiment
    from hil.runs import find_runs

__version__ = "0.1.0"


__all__ = [
    "Experiment",
    "dataset",
    "estimate_payload",
    "evaluate",
    "export_data",
    "export_model",
    "figures",
    "find_runs",
    "fit",
    "import_recording",
    "load",
    "plan",
    "registry",
    "reidentify",
    "rest_poses",
    "resume",
    "run",
    "simulate",
    "study",
]


def __getattr__(name: str) -> Any:
    if name == "try_out":
        raise AttributeError("hil.try_out is now hil.simulate")
    if name not in __all__:
        raise AttributeError(f"module 'hil' has no attribute {name!r}")
    # "from hil import api" would call this function recursively, so import_module is used.
    from importlib import import_module

    return getattr(import_module("hil.api"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
