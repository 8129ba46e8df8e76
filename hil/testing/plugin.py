"""Pytest plug-in `hil`: mock robots for tests of other packages (entry point `pytest11`).

Every pytest session loads this plug-in if hil is installed. The plug-in imports no other module
until a fixture is used (names of `hil.testing` are loaded on first use), and has no other effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, TypeVar

import pytest

from hil import testing

T = TypeVar("T")

MARKERS = (
    "mock_robot(model, seed, **options): factory of the fixture mock_robot, such as model='ur10e'",
    "ur_controller(model, seed, **options): factory of the fixture ur_controller, such as speed=10",
    "can_bus(model, seed, **options): factory of the fixture can_bus, such as bitrate=1_000_000",
)


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers, which `--strict-markers` and `pytest --markers` need."""
    for marker in MARKERS:
        config.addinivalue_line("markers", marker)


@pytest.fixture
def mock_robot_factory() -> Iterator[Callable[..., testing.MockRobot]]:
    """Yield a function that creates connected embedded mock robots for one test."""
    with _factory(testing.mock_robot) as make:
        yield make


@pytest.fixture
def ur_controller_factory() -> Iterator[Callable[..., testing.UrController]]:
    """Yield a function that starts mock UR controllers with separate addresses for one test."""
    with _factory(testing.ur_controller) as make:
        yield make


@pytest.fixture
def can_bus_factory() -> Iterator[Callable[..., testing.CanBus]]:
    """Yield a function that starts mock CiA 402 drives with separate buses for one test."""
    with _factory(testing.can_bus) as make:
        yield make


@pytest.fixture
def mock_robot(
    request: pytest.FixtureRequest, mock_robot_factory: Callable[..., testing.MockRobot]
) -> testing.MockRobot:
    """Return a connected mock robot inside this process; see the marker `mock_robot`."""
    return _marked(request, "mock_robot", mock_robot_factory)


@pytest.fixture
def ur_controller(
    request: pytest.FixtureRequest, ur_controller_factory: Callable[..., testing.UrController]
) -> testing.UrController:
    """Return a mock UR controller on real sockets; see the marker `ur_controller`."""
    return _marked(request, "ur_controller", ur_controller_factory)


@pytest.fixture
def can_bus(
    request: pytest.FixtureRequest, can_bus_factory: Callable[..., testing.CanBus]
) -> testing.CanBus:
    """Return mock CiA 402 drives on a CAN bus; see the marker `can_bus`."""
    return _marked(request, "can_bus", can_bus_factory)


@pytest.fixture
def robot_conformance() -> testing.Conformance:
    """Return `hil.testing.robot_conformance`, which checks a driver against the robot protocol."""
    return testing.robot_conformance


def _marked(request: pytest.FixtureRequest, name: str, make: Callable[..., T]) -> T:
    marker = request.node.get_closest_marker(name)
    return make(*marker.args, **marker.kwargs) if marker else make()


@contextmanager
def _factory(start: Callable[..., AbstractContextManager[T]]) -> Iterator[Callable[..., T]]:
    """Yield a function that starts mocks; all mocks end after the block.

    An error of a mock fails the test without printing a traceback.
    """
    from hil.core import HilError

    with ExitStack() as running:

        def make(*arguments: Any, **options: Any) -> T:
            try:
                return running.enter_context(start(*arguments, **options))
            except HilError as error:
                why = str(error)
            return pytest.fail(why, pytrace=False)

        yield make
