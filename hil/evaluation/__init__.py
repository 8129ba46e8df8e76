"""Errors per joint, trajectory and load, and the verdict against a spec's criteria."""

from hil.evaluation.evaluation import Errors, Evaluation, evaluate, filtered_effort
from hil.evaluation.verdict import Criterion, Verdict, VerdictRow, judge

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
