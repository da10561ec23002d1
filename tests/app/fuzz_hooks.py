"""For schemathesis: ids of things that are there, in most requests; else nearly all of them end with 404.

`fuzz_api.py` names them in the environment: `LENSMODEL_FUZZ_IDS` maps names of parameters to ids, and
`LENSMODEL_FUZZ_SPARE` lists photos that may be deleted.
"""

from __future__ import annotations

import json
import os
import random
from typing import Any

import schemathesis

IDS: dict[str, list[str]] = json.loads(os.environ.get("LENSMODEL_FUZZ_IDS", "{}"))
SPARE: list[str] = json.loads(os.environ.get("LENSMODEL_FUZZ_SPARE", "[]"))
KNOWN_SHARE = 0.7
"""Of requests about something that is there (chosen); the others ask for what is made up."""

_rng = random.Random(0)


@schemathesis.hook
def before_call(context: Any, case: Any, **kwargs: Any) -> None:
    """Put known ids in place of made-up ones."""
    del context, kwargs
    if _rng.random() > KNOWN_SHARE:
        return
    deletes = case.method.upper() == "DELETE"
    for part in (case.path_parameters, case.body, case.query):
        if not isinstance(part, dict):
            continue
        for name in IDS.keys() & part.keys():
            if not deletes:
                part[name] = _rng.choice(IDS[name])
            elif name == "photo_id" and SPARE:
                part[name] = SPARE.pop()
