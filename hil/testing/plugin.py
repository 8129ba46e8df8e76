"""The pytest plug-in `hil`: mock robots for other people's tests (entry point group `pytest11`).

Everybody's pytest loads this where hil is installed: it imports nothing else until a fixture is
used, and changes nothing by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

if TYPE_CHECKING:
    from hil.testing.can_bus import CanBus
    from hil.testing.conformance import Conformance
    from hil.testing.embedded import MockRobot
    from hil.testing.mock_ur_controller import UrController

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
def mock_robot_factory() -> Iterator[Callable[..., MockRobot]]:
    """Makes embedded mock robots, each connected; closed after the test."""
    from hil.testing.embedded import mock_robot

    with _factory(mock_robot) as make:
        yield make


@pytest.fixture
def ur_controller_factory() -> Iterator[Callable[..., UrController]]:
    """Starts mock UR controllers, each on its own address; ended after the test."""
    from hil.testing.mock_ur_controller import ur_controller

    with _factory(ur_controller) as make:
        yield make


@pytest.fixture
def can_bus_factory() -> Iterator[Callable[..., CanBus]]:
    """Starts mock CiA 402 drives, each arm on its own bus; ended after the test."""
    from hil.testing.can_bus import can_bus

    with _factory(can_bus) as make:
        yield make


@pytest.fixture
def mock_robot(
    request: pytest.FixtureRequest, mock_robot_factory: Callable[..., MockRobot]
) -> MockRobot:
    """A connected robot that exists only in this process; see the marker of the same name."""
    return _marked(request, "mock_robot", mock_robot_factory)


@pytest.fixture
def ur_controller(
    request: pytest.FixtureRequest, ur_controller_factory: Callable[..., UrController]
) -> UrController:
    """A mock UR controller on real sockets; see the marker of the same name."""
    return _marked(request, "ur_controller", ur_controller_factory)


@pytest.fixture
def can_bus(request: pytest.FixtureRequest, can_bus_factory: Callable[..., CanBus]) -> CanBus:
    """Mock CiA 402 drives on a CAN bus; see the marker of the same name."""
    return _marked(request, "can_bus", can_bus_factory)


@pytest.fixture
def robot_conformance() -> Conformance:
    """`hil.testing.conformance.robot_conformance`: does a driver keep the contract of a robot?"""
    from hil.testing import conformance

    return conformance.robot_conformance


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
