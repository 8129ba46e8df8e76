"""The mock drives in a thread of this process, for tests on a virtual bus."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from hil_mock_robot.cia402.assembly import Mock
from hil_mock_robot.cia402.bus import end_of
from hil_mock_robot.plant.truth import Profile, draw_truth

T = TypeVar("T")
ANSWER_S = 30.0


class HostedMock:
    """A mock that a thread runs.

    Args:
        mock: The mock; others may touch it by `ask` only.
    """

    def __init__(self, mock: Mock) -> None:
        self._mock = mock
        self._mishap: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hil-mock-can", daemon=True)
        self._thread.start()

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """A request of the side channel; its answer.

        Raises:
            HilError: It cannot be done.
        """
        return self.ask(lambda mock: mock.requests.answer({"do": do, **more}))

    def ask(self, question: Callable[[Mock], T]) -> T:
        """What the mock's own thread finds, between two frames; what it raises is raised here."""
        done = threading.Event()
        found: list[T] = []
        raised: list[Exception] = []

        def answer() -> None:
            try:
                found.append(question(self._mock))
            except Exception as error:
                raised.append(error)
            done.set()

        self._mock.loop.ask(answer)
        while not done.wait(0.1):
            if not self._thread.is_alive():
                raise RuntimeError("the mock has ended") from self._mishap
        if raised:
            raise raised[0]
        return found[0]

    def close(self) -> None:
        """End it; raises what it stumbled over."""
        self._mock.loop.end()
        self._thread.join(ANSWER_S)
        if self._mishap is not None:
            raise self._mishap

    def _run(self) -> None:
        try:
            self._mock.loop.run()
        except BaseException as error:
            self._mishap = error


@contextmanager
def mock_on_virtual_bus(
    channel: str,
    *,
    interface: str = "virtual",
    model: str = "lab6",
    seed: int = 1,
    profile: Profile = "full",
    bitrate: float | None = None,
    **options: Any,
) -> Iterator[HostedMock]:
    """Run mock drives in a thread while the block runs; the bus is there when it begins.

    Args:
        channel: Of the bus.
        interface: Of python-can; on `hil_unix` the mock hosts the bus.
        model: A built-in arm.
        seed: Which individual.
        profile: Of the physics.
        bitrate: Of the wire, where it is modelled.
        **options: As of `Mock`.
    """
    end = end_of(interface, channel, bitrate)
    try:
        mock = Mock(draw_truth(model, seed, profile), end, **options)
    except BaseException:
        end.close()
        raise
    hosted = HostedMock(mock)
    try:
        yield hosted
    finally:
        hosted.close()
