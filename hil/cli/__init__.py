"""Command line: a file per verb or group of verbs, named after it; what it does is elsewhere.

A new verb is a file with a `typer.Typer()` called `app` and a word in `hil.cli.app.FILES`. Verbs
share `options` (arguments and options), `output` (JSON, text, tables) and `progress`; `run` and
`resume` of a series are in `series`, and `completion` knows which words fit on Tab.

Files with verbs do without `from __future__ import annotations`: typer would evaluate the text of
each annotation twice, which took a tenth of the time of `hil --help`.
"""

from hil.cli.app import main

__all__ = ["main"]
