"""The pytest plug-in `hil`: mock robots for other people's tests (entry point group `pytest11`).

Everybody's pytest loads this where hil is installed: it imports nothing else until a fixture is
used (names of the face `hil.testing` are loaded when asked for), and changes nothing by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, TypeVar

import pytest

from hil import testing

T = TypeVar("T")

MARKERS = (
    "mock_robot(model, seed, **options): what the fixture mock_robot is, such as model='ur10e'",
    "ur_controller(model, seed, **options): what the fixture ur_controller is, such as speed=10",
    "can_bus(model, seed, **options): what the fixture can_bus is, such as bitrate=1_000_000",
)


def pytest_configure(config: pytest.Config) -> None:
    """Make the markers known, for `--strict-markers` and `pytest --markers`."""
    for marker in MARKERS:
        config.addinivalue_line("markers", marker)


@pytest.fixture
def mock_robot_factory() -> Iterator[Callable[..., testing.MockRobot]]:
    """Makes embedded mock robots, each connected; closed after the test."""
    with _factory(testing.mock_robot) as make:
        yield make


@pytest.fixture
def ur_controller_factory() -> Iterator[Callable[..., testing.UrController]]:
    """Starts mock UR controllers, each on its own address; ended after the test."""
    with _factory(testing.ur_controller) as make:
        yield make


@pytest.fixture
def can_bus_factory() -> Iterator[Callable[..., testing.CanBus]]:
    """Starts mock CiA 402 drives, each arm on its own bus; ended after the test."""
    with _factory(testing.can_bus) as make:
        yield make


@pytest.fixture
def mock_robot(
    request: pytest.FixtureRequest, mock_robot_factory: Callable[..., testing.MockRobot]
) -> testing.MockRobot:
    """A connected robot that exists only in this process; see the marker of the same name."""
    return _marked(request, "mock_robot", mock_robot_factory)


@pytest.fixture
def ur_controller(
    request: pytest.FixtureRequest, ur_controller_factory: Callable[..., testing.UrController]
) -> testing.UrController:
    """A mock UR controller on real sockets; see the marker of the same name."""
    return _marked(request, "ur_controller", ur_controller_factory)


@pytest.fixture
def can_bus(
    request: pytest.FixtureRequest, can_bus_factory: Callable[..., testing.CanBus]
) -> testing.CanBus:
    """Mock CiA 402 drives on a CAN bus; see the marker of the same name."""
    return _marked(request, "can_bus", can_bus_factory)


@pytest.fixture
def robot_conformance() -> testing.Conformance:
    """`hil.testing.robot_conformance`: does a driver keep the contract of a robot?"""
    return testing.robot_conformance


def _marked(request: pytest.FixtureRequest, name: str, make: Callable[..., T]) -> T:
    marker = request.node.get_closest_marker(name)
    return make(*marker.args, **marker.kwargs) if marker else make()


@contextmanager
def _factory(start: Callable[..., AbstractContextManager[T]]) -> Iterator[Callable[..., T]]:
    """Start as many as are asked for, end all; what cannot be is one message, no traceback."""
    from hil.core import HilError

    with ExitStack() as running:

        def make(*arguments: Any, **options: Any) -> T:
            try:
                return running.enter_context(start(*arguments, **options))
            except HilError as error:
                why = str(error)
            return pytest.fail(why, pytrace=False)

        yield make
