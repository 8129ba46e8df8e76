"""The Python API: what the command line does with experiments, recordings and models.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'

A file per subject; every function is here by its name, and in `hil` as well.
"""

from __future__ import annotations

from hil.api.arguments import AnyPath, parse_parameters
from hil.api.experiments import figures, load, plan, resume, run, study
from hil.api.models import estimate_payload, evaluate, fit
from hil.api.recordings import dataset, export_data, import_recording
from hil.api.upkeep import registry, reidentify
from hil.api.uses import export_model, rest_poses, try_out
from hil.planning.experiment import Experiment
from hil.runs.summary import describe_run, list_runs
from hil.runs.view import find_runs
from hil.workflow.run import RunReport

__all__ = [
    "AnyPath",
    "Experiment",
    "RunReport",
    "dataset",
    "describe_run",
    "estimate_payload",
    "evaluate",
    "export_data",
    "export_model",
    "figures",
    "find_runs",
    "fit",
    "import_recording",
    "list_runs",
    "load",
    "parse_parameters",
    "plan",
    "registry",
    "reidentify",
    "rest_poses",
    "resume",
    "run",
    "study",
    "try_out",
]
