"""The `hil` command: gathers the verbs and turns errors into messages and exit codes."""

from __future__ import annotations

import json
import os
import sys

import typer

from hil.cli import bench, data, models, runs, specs, system
from hil.errors import HilError, exit_code_of

EXIT_CODES = (
    "Exit codes: 0 done · 2 spec or plan · 3 preflight · 4 robot · 5 interlock · 6 stopped "
    "(130 by signal) · 7 recording · 8 data · 9 fit · 10 model rejected · 11 registry."
)

app = typer.Typer(
    name="hil",
    help="From one YAML file to a validated robot model.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (specs, runs, models, data, system, bench):
    group.register(app)


def main() -> None:
    """Entry point of the `hil` script."""
    _one_blas_thread()
    try:
        app(prog_name="hil")
    except HilError as error:
        _tell(error)
        sys.exit(exit_code_of(error))
    except BrokenPipeError:
        # `hil runs | head`: the reader has gone, which is its right.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def _one_blas_thread() -> None:
    """Idle BLAS threads spin: measured 20× slower on two busy cores (must precede numpy)."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")


def _tell(error: HilError) -> None:
    kind = type(error).__name__
    if "--json" in sys.argv:
        told = {
            "kind": kind,
            "message": error.message,
            "hint": error.hint,
            "exit_code": exit_code_of(error),
        }
        typer.echo(json.dumps({"error": told}, ensure_ascii=False))
    typer.secho(f"{kind}: {error.message}", err=True, fg=typer.colors.RED)
    if error.hint:
        typer.echo(f"  next: {error.hint}", err=True)
