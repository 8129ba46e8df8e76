"""The `hil` command: gathers the verbs, and turns errors into messages and exit codes.

A verb is a function in a file of this folder, named after it or after the group of verbs it belongs
to, and decorated with the `app` of that file. `FILES` lists the files.
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
    "validate", "plan", "excite", "run", "record", "runs", "prune", "live", "recover", "replay",
    "fit", "report", "gains", "new", "explain", "payload", "study", "models", "drift", "reidentify",
    "fleet", "schedule", "serve", "rest_pose", "export", "try_out", "data", "mock", "doctor",
    "bench",
)  # fmt: skip
"""Files with verbs, in the order of `hil --help`."""

EXIT_CODES = (
    "Exit codes: 0 done · 2 spec or plan · 3 preflight · 4 robot · 5 interlock · 6 stopped "
    "(130 by signal) · 7 recording · 8 data · 9 fit · 10 model rejected · 11 registry."
)

app = typer.Typer(
    name="hil",
    epilog=EXIT_CODES,
    no_args_is_help=True,
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
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Say which hil."),
    ] = False,
) -> None:
    """From one YAML file to a validated robot model."""


def main() -> None:
    """Entry point of the `hil` script."""
    _one_blas_thread()
    _end_like_ctrl_c()
    out = guard_streams()
    if "_HIL_COMPLETE" in os.environ:  # a shell asks which words fit
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
    """Idle BLAS threads spin: measured 20× slower on two busy cores (must precede numpy)."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")


def _end_like_ctrl_c() -> None:
    """Let SIGTERM and a lost terminal end a command as Ctrl-C does: message and exit code 130."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


def _report(error: HilError, out: Stream | None) -> int:
    """Print an error and return its exit code."""
    kind, code = type(error).__name__, exit_code_of(error)
    _print_json_error(out, kind, error.message, error.hint, code)
    width = width_of(sys.stderr)
    typer.secho(fold(f"{kind}: {error.message}", width), err=True, fg=typer.colors.RED)
    if error.hint:
        typer.echo(fold(f"  next: {error.hint}", width), err=True)
    return code


def _as_ours(error: OSError) -> HilError:
    """Return what the system refused as one of our errors; nearly always it is a file to write."""
    message = ": ".join(str(part) for part in (error.filename, error.strerror or error) if part)
    if isinstance(error, ConnectionError | TimeoutError):
        return RobotConnectionError(message, hint="see whether the robot is on and can be reached")
    if _is_of_an_installation(error):
        hint = "the installation lacks a file of its own or cannot read it: install hil again"
        return PluginError(message, hint=hint)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return RecordingError(message, hint="make room on the disk, or write to another place")
    if _may_not_be_read(error):
        return DataError(f"cannot read {message}", hint="see whether you may read it")
    return RecordingError(message, hint="see whether the path exists and may be written to")


def _is_of_an_installation(error: OSError) -> bool:
    """Return whether it is about a file that came with hil, a driver or a mock robot."""
    if not isinstance(error.filename, str):
        return False
    loaded = (sys.modules.get(name) for name in ("hil", "hil_mock_robot", "hil_drivers"))
    folders = [Path(file).parent for module in loaded if (file := getattr(module, "__file__", ""))]
    return any(Path(error.filename).is_relative_to(folder) for folder in folders)


def _may_not_be_read(error: OSError) -> bool:
    """Return whether a file is there that this user may not read, or a folder not be entered."""
    if error.errno not in (errno.EACCES, errno.EPERM) or not isinstance(error.filename, str):
        return False
    folder = os.path.dirname(error.filename) or "."
    mine = {"effective_ids": os.access in os.supports_effective_ids}
    if os.access(error.filename, os.F_OK, **mine):
        return not os.access(error.filename, os.R_OK, **mine)
    return not os.access(folder, os.X_OK, **mine) and os.path.lexists(folder)


def _exit_code(ending: SystemExit, out: Stream | None) -> int:
    """Return the exit code of a command that typer has ended; print what `--json` still lacks."""
    code, cause = ending.code, ending.__context__
    if isinstance(cause, BrokenPipeError):  # not of our own streams, which bear it
        return _report(_as_ours(cause), out)
    if not isinstance(code, int):
        return int(code is not None)
    interrupted = Stopped("interrupted", by_signal=True)
    if code == exit_code_of(interrupted) and not (out and out.used):
        return _report(interrupted, out)
    if code:
        message: Any = getattr(cause, "format_message", str)  # of a wrong command line
        _print_json_error(out, type(cause).__name__, str(message()), "hil COMMAND --help", code)
    return code


def _print_json_error(out: Stream | None, kind: str, message: str, hint: str, code: int) -> None:
    """Print the one document of a command that failed before it could print its own."""
    if "--json" not in sys.argv or out is None or out.used:
        return
    error = {"kind": kind, "message": message, "hint": hint, "exit_code": code}
    with contextlib.suppress(OSError):  # standard output may be what has failed
        typer.echo(json_text({"error": error}))
