"""What all tests need: signals that are delivered, a checkout left as it was, shared recordings."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

WATCHED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def pytest_configure() -> None:
    """Let programs that tests start import `tests`, and let Ctrl-C be delivered to this one.

    Shells start what runs in the background with SIGINT ignored. Each process has one BLAS thread,
    as under `make`: two workers with two threads each take twice the time.
    """
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    paths = [str(Path(__file__).parents[1]), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(filter(None, paths)))
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def signals_are_heard() -> None:
    """The command line ignores late signals once its work is done; in here it is not the end.

    Fixtures of modules call it, too, before a test is asked what it found.
    """
    for number in WATCHED:
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, default)


CHECKOUT = Path(__file__).parents[1]


def visible() -> set[str]:
    """Names in the checkout's root; tools keep what they remember in hidden ones."""
    return {name for name in os.listdir(CHECKOUT) if not name.startswith(".")}


@pytest.fixture(autouse=True)
def nothing_is_left_in_the_checkout() -> Iterator[None]:
    """Fail a test during which a file appears there; it may be of the test of another worker."""
    before = visible()
    yield
    left = sorted(visible() - before)
    assert not left, f"{', '.join(left)} appeared in the checkout; tests write to tmp_path"


@pytest.fixture(scope="session")
def dwell_lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run of a dwell program and its registered model; nobody changes it."""
    from tests.support.recorded import dwells_in, once

    return once(tmp_path_factory, "dwells", dwells_in)


@pytest.fixture(scope="session")
def dwell_run(dwell_lab: Path) -> Path:
    """The directory of that run."""
    from tests.support.recorded import run_in

    return run_in(dwell_lab)


@pytest.fixture(scope="session")
def fourier_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the run of a Fourier program; nobody changes it."""
    from tests.support.recorded import once, run_in, trajectories_in

    return run_in(once(tmp_path_factory, "trajectories", trajectories_in))


@pytest.fixture
def plans_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take plans that an earlier test has made: for tests of what is done with a plan."""
    from tests.support.plans_once import share_plans

    share_plans(monkeypatch)
