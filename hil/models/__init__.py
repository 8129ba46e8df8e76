"""Registry of immutable model versions, with comparison before promotion, and rollback.

- ``REGISTRY/NAME/v0001/`` is the folder of a version: it contains the model files, and
  `version.json` with origin and digests.
- ``REGISTRY/NAME/log.jsonl`` is the log of all events of a model name. The log of a model name
  determines its champion.
- ``REGISTRY/NAME/aliases.json`` names champion and challenger for human readers. The file
  `aliases.json` is generated from the log.

`hil.registry("registry")` opens the registry in the folder `registry`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
