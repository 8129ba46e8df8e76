"""Entry point of `python -m hil`, which is equivalent to `hil`."""

from hil.cli import main

if __name__ == "__main__":
    main()
