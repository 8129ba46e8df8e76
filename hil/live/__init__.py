"""Watching a run while it goes on: where it stands, in words and over the network."""

from hil.live.server import FoxgloveLive
from hil.live.standing import Standing

__all__ = ["FoxgloveLive", "Standing"]
