"""Plans as files: what is read back is a plan, or an error that says what is wrong with it."""

from __future__ import annotations

from pathlib import Path

from hil.core import read_json
from hil.planning.document import require_plan
from hil.planning.plan import Plan


def read_plan(path: Path) -> Plan:
    """The plan a JSON file holds, equal to the one that was written, hash included.

    Whether it is the plan a run was begun with is for the caller to see: compare `Plan.hash` with
    the start document's `plan_hash`.

    Raises:
        DataError: The file is missing, no JSON, no plan (with the place of everything that is
            wrong), or was written by a newer hil.
    """
    document = read_json(path)
    require_plan(document, str(path))
    return Plan.from_dict(document)
