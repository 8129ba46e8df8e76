"""A process that registers, promotes and rolls back until it is killed; it says what it has done.

python registry_writer.py REGISTRY SEED MODEL…
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

from hil.core.errors import RegistryError
from hil.models.model_registry import Registry


def say(line: str) -> None:
    """Tell the test, which reads until the kill."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    registry = Registry(Path(sys.argv[1]))
    dice, models = random.Random(int(sys.argv[2])), [Path(given) for given in sys.argv[3:]]
    say("ready")
    while True:
        model = dice.choice(models)
        number = registry.register("arm", model, {}, challenger=dice.random() < 0.5).number
        say(f"registered {number}")
        champion = registry.aliases("arm").champion
        try:
            if number != champion and dice.random() < 0.7:
                registry.promote("arm", number, reason="", evidence={}, instead_of=champion)
                say(f"promoted {number}")
            else:
                say(f"rolled-back {registry.roll_back('arm', reason='').champion}")
        except RegistryError:
            continue


if __name__ == "__main__":
    main()
