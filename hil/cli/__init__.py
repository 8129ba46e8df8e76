"""Command line: one file per verb group, no logic.

Files with verbs do without `from __future__ import annotations`: typer would evaluate the text of
each annotation twice, which took a tenth of the time of `hil --help`.
"""

from hil.cli.app import main

__all__ = ["main"]
