"""Command line: one file per verb group, no logic."""

from hil.cli.app import main

__all__ = ["main"]
