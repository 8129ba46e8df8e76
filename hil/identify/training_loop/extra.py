"""Whether networks can be trained here."""

from __future__ import annotations

from importlib.util import find_spec

from hil.errors import PluginError

LEARN = {"learn": "to train its network"}
"""`RobotEstimator.extras` of whatever calls `require_torch` in a fit."""


def require_torch() -> None:
    """Refuse to train, or to restore a network that only PyTorch computes, without it.

    Raises:
        PluginError: The extra `learn` is missing.
    """
    if find_spec("torch") is None:
        raise PluginError(
            "this network needs torch, which is not installed", hint='pip install "hil[learn]"'
        )
