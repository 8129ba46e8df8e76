"""The `hil` command: collects the verbs, and converts errors into messages and exit codes.

A verb is a function in a file of this folder, decorated with the `app` of that file. The file of a
verb is named after the verb or after its group of verbs. The constant `FILES` lists the files with
verbs.
"""

import contextlib
import errno
import os
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

import hil
from hil.cli.output import fold, ignore_from_now_on, width_of
from hil.cli.streams import Stream, guard_streams
from hil.core import (
    DataError,
    HilError,
    PluginError,
    RecordingError,
    RobotConnectionError,
    Stopped,
    exit_code_of,
    json_text,
)

FILES = (
    "new", "validate", "plan", "optimise", "explain", "run", "record", "live", "runs", "report",
    "study", "prune", "fit", "payload", "drive_gains", "models", "export", "simulate", "rest_pose",
    "data", "recover", "replay", "drift", "reidentify", "schedule", "fleet", "serve", "doctor",
    "mock", "bench",
)  # fmt: skip
"""Files with verbs."""

PANELS = {
    "Author": ("new", "validate", "plan", "optimise", "explain", "schema"),
    "Run": ("run", "resume", "watch", "pause", "stop", "answer", "record", "robots"),
    "Results": ("runs", "show", "report", "figures", "study", "prune"),
    "Models": (
        "fit", "evaluate", "validate-loads", "payload", "drive-gains", "models", "export",
        "simulate", "rest-pose",
    ),
    "Data": ("import", "export-data", "recover", "replay"),
    "Upkeep": ("drift", "reidentify", "schedule", "fleet"),
    "System": ("serve", "doctor", "mock", "plugins", "bench"),
}  # fmt: skip
"""Panels of `hil --help`, each with its verbs in order."""

RENAMED = {
    "excite": "optimise", "try-out": "simulate", "gains": "drive-gains",
    "--elsewhere": "--no-console", "--first": "--limit", "--speed": "--speed-scale",
    "--truth": "--ground-truth",
    "--unchecked": "--no-check (export) or --no-collision-check (rest-pose)",
}  # fmt: skip
"""Present names of verbs and options, by former name."""


class Verbs(TyperGroup):
    """Group of all verbs in panels; errors about a former name state the present name."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        for panel, names in PANELS.items():
            for name in names:
                self.commands[name].rich_help_panel = panel  # type: ignore[attr-defined]

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the verbs in the order of the panels."""
        return [name for names in PANELS.values() for name in names]

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, verb and remaining arguments; end with a message if the verb is unknown."""
        if args[0] in RENAMED:
            ctx.fail(f"`hil {args[0]}` is now `hil {RENAMED[args[0]]}`.")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Execute the verb that the command line names."""
        try:
            return super().invoke(ctx)
        except TyperException as error:
            option = getattr(error, "option_name", "")
            if option in RENAMED:
                ctx.fail(f"{option} is now {RENAMED[option]}.")
            raise


EXIT_CODES = (
    "Exit codes: 0 done · 2 spec or plan · 3 preflight · 4 robot · 5 interlock · 6 stopped "
    "(130 by signal) · 7 recording · 8 data · 9 fit · 10 model rejected · 11 registry."
)

app = typer.Typer(
    name="hil",
    cls=Verbs,
    epilog=EXIT_CODES,
    invoke_without_command=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for file in FILES:
    app.add_typer(import_module(f"hil.cli.{file}").app)


def _print_version(version: bool) -> None:
    if version:
        typer.echo(f"hil {hil.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """From one YAML file to a validated robot model.

    Without a command, list the commands that are useful next in the current folder.
    """
    if context.invoked_subcommand is None:
        from hil.cli.overview import print_overview

        print_overview()


def main() -> None:
    """Run the `hil` script."""
    _one_blas_thread()
    _end_like_ctrl_c()
    out = guard_streams()
    if "_HIL_COMPLETE" in os.environ:  # a shell asks for completions
        from hil.cli.completion import attach

        attach(app)
    try:
        app(prog_name="hil")
    except HilError as error:
        sys.exit(_report(error, out))
    except OSError as error:
        sys.exit(_report(_as_ours(error), out))
    except SystemExit as ending:
        sys.exit(_exit_code(ending, out))
    finally:
        ignore_from_now_on()


def _one_blas_thread() -> None:
    """Limit BLAS to one thread; must be called before numpy is imported.

    Idle BLAS threads spin: on two busy cores, a command was 20 times slower with several threads.
    """
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")


def _end_like_ctrl_c() -> None:
    """Handle SIGTERM and SIGHUP like Ctrl-C: message and exit code 130."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


def _report(error: HilError, out: Stream | None) -> int:
    """Print an error and return the exit code of the error."""
    kind, code = type(error).__name__, exit_code_of(error)
    _print_json_error(out, kind, error.message, error.hint, code)
    width = width_of(sys.stderr)
    typer.secho(fold(f"{kind}: {error.message}", width), err=True, fg=typer.colors.RED)
    if error.hint:
        typer.echo(fold(f"  next: {error.hint}", width), err=True)
    return code


def _as_ours(error: OSError) -> HilError:
    """Return an error of hil for an error of the operating system.

    Nearly all errors of the operating system are about files that cannot be written.
    """
    message = ": ".join(str(part) for part in (error.filename, error.strerror or error) if part)
    if isinstance(error, ConnectionError | TimeoutError):
        return RobotConnectionError(
            message, hint="check that the robot is switched on and reachable"
        )
    if _is_of_an_installation(error):
        hint = "a file of the installation is missing or unreadable: install hil again"
        return PluginError(message, hint=hint)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return RecordingError(message, hint="free disk space, or choose a different folder")
    if _may_not_be_read(error):
        return DataError(f"cannot read {message}", hint="check the permissions of the path")
    return RecordingError(message, hint="check that the path exists and is writable")


def _is_of_an_installation(error: OSError) -> bool:
    """Return whether an error is about an installed file of hil, the drivers or the mock robots."""
    if not isinstance(error.filename, str):
        return False
    loaded = (sys.modules.get(name) for name in ("hil", "hil_mock_robot", "hil_drivers"))
    folders = [Path(file).parent for module in loaded if (file := getattr(module, "__file__", ""))]
    return any(Path(error.filename).is_relative_to(folder) for folder in folders)


def _may_not_be_read(error: OSError) -> bool:
    """Return whether an error is about an existing path that this user is not allowed to read."""
    if error.errno not in (errno.EACCES, errno.EPERM) or not isinstance(error.filename, str):
        return False
    folder = os.path.dirname(error.filename) or "."
    mine = {"effective_ids": os.access in os.supports_effective_ids}
    if os.access(error.filename, os.F_OK, **mine):
        return not os.access(error.filename, os.R_OK, **mine)
    return not os.access(folder, os.X_OK, **mine) and os.path.lexists(folder)


def _exit_code(ending: SystemExit, out: Stream | None) -> int:
    """Return the exit code of a command that typer has ended; print a missing JSON document."""
    code, cause = ending.code, ending.__context__
    if isinstance(cause, BrokenPipeError):  # not from the standard streams
        return _report(_as_ours(cause), out)
    if not isinstance(code, int):
        return int(code is not None)
    interrupted = Stopped("interrupted", by_signal=True)
    if code == exit_code_of(interrupted) and not (out and out.used):
        return _report(interrupted, out)
    if code:
        message: Any = getattr(cause, "format_message", str)  # error of the command line
        _print_json_error(out, type(cause).__name__, str(message()), "hil COMMAND --help", code)
    return code


def _print_json_error(out: Stream | None, kind: str, message: str, hint: str, code: int) -> None:
    """Print the JSON document of a command that failed before printing its own document."""
    if "--json" not in sys.argv or out is None or out.used:
        return
    error = {"kind": kind, "message": message, "hint": hint, "exit_code": code}
    with contextlib.suppress(OSError):  # standard output may be what has failed
        typer.echo(json_text({"error": error}))
