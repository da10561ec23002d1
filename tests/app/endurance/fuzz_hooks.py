"""For schemathesis: ids of things that are there, in most requests; else nearly all of them end with 404.

`fuzz_api.py` names them in the environment: `LENSMODEL_FUZZ_IDS` maps names of parameters to ids,
`LENSMODEL_FUZZ_SPARE` lists photos that may be deleted, and `LENSMODEL_FUZZ_PROFILE` is a profile to send,
whole or damaged.
"""

from __future__ import annotations

import json
import os
import random
from pathlib import Path
from typing import Any

import schemathesis

IDS: dict[str, list[str]] = json.loads(os.environ.get("LENSMODEL_FUZZ_IDS", "{}"))
SPARE: list[str] = json.loads(os.environ.get("LENSMODEL_FUZZ_SPARE", "[]"))
PROFILE = os.environ.get("LENSMODEL_FUZZ_PROFILE")
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


@schemathesis.serializer("application/zip")
def archive(context: Any, value: Any) -> bytes:
    """Send a profile, mostly with some of its bytes changed or its end cut off, or what was made up."""
    del context
    made_up = value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")
    if PROFILE is None or _rng.random() > KNOWN_SHARE:
        return made_up
    whole = bytearray(Path(PROFILE).read_bytes())
    for _ in range(_rng.choice((0, 1, 4, 16))):
        whole[_rng.randrange(len(whole))] = _rng.randrange(256)
    return bytes(whole[: _rng.choice((len(whole), _rng.randrange(len(whole))))])
