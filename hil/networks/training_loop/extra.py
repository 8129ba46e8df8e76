"""Whether networks can be trained here."""

from __future__ import annotations

from importlib.util import find_spec

from hil.core import plugins
from hil.estimators import Needs

LEARN = {"learn": "to train its network"}
"""`RobotEstimator.extras` of whatever calls `require_torch` in a fit."""

TO_TRAIN = Needs({"samples": 100}, gains=True)
"""What no network can be trained without."""


def require_torch() -> None:
    """Refuse to train, or to restore a network that only PyTorch computes, without it.

    Raises:
        PluginError: The extra `learn` is missing.
    """
    if find_spec("torch") is None:
        raise plugins.not_installed("this network", ["torch"], "learn")
