"""Versions of models: immutable, compared before promotion, and kept for going back to.

``REGISTRY/NAME/v0001/`` is a version: model files, and `version.json`, what it is, with digests.
``REGISTRY/NAME/log.jsonl`` says what was done, line by line: the truth about champions.
``REGISTRY/NAME/aliases.json`` names champion and challenger for people; it is made from the log.

`hil.registry("registry")` opens one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
