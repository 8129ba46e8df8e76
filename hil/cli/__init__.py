"""Command line of hil: one file per verb or group of verbs, named after the verb or group.

A new verb is a file with a `typer.Typer()` called `app`; the name of the file is listed in
`hil.cli.app.FILES`. The verbs share the modules `options` (arguments and options), `output` (JSON,
text, tables) and `progress`. The verbs `run` and `resume` use the module `series` for a series. The
module `completion` finds the words for shell completion.

Files with verbs do not use `from __future__ import annotations`, because typer would evaluate the
text of each annotation twice, which took a tenth of the time of `hil --help`.
"""

from hil.cli.app import main

__all__ = ["main"]
