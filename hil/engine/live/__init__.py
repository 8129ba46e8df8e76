"""Watching a run while it goes on: where it stands, in words and over the network."""

from hil.engine.live.server import FoxgloveLive
from hil.engine.live.standing import Standing

__all__ = ["FoxgloveLive", "Standing"]
