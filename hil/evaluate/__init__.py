"""Errors per joint, trajectory and load, and the verdict against a spec's criteria."""

from hil.callable_module import make_callable
from hil.evaluate.evaluation import Errors, Evaluation, evaluate, filtered_effort
from hil.evaluate.verdict import Criterion, Verdict, VerdictRow, judge

__all__ = [
    "Criterion",
    "Errors",
    "Evaluation",
    "Verdict",
    "VerdictRow",
    "evaluate",
    "filtered_effort",
    "judge",
]

make_callable(__name__)
