"""Logging of the service's processes: each record begins a line, whatever its text contains.

People read lines of text; collectors read one JSON object a line (`LENS_LOG_FORMAT=json`). Both name the
request, the job and the photo of a record, wherever in the program it was logged.
"""

from __future__ import annotations

import json
import logging
import re
import sys
from datetime import UTC, datetime
from typing import Any, Final, Literal, TypeAlias

from structlog.contextvars import get_contextvars

Format: TypeAlias = Literal["text", "json"]

# Prefix of each further line of a record: no text from outside can imitate a record
CONTINUED: Final = "\n    | "
# Fields of a record besides its text; the same names in the context of a thread and in `extra`
FIELDS: Final = (
    *("request_id", "job_id", "photo_id", "lens_id", "correction_id", "method", "path", "status", "ms"),
)
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


class OneRecord(logging.Formatter):
    """Formatter that escapes control characters: neither lines nor terminal sequences can be forged."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a record with the ids of its context and control characters escaped."""
        context = get_contextvars()
        ids = "".join(f" {name}={context[name]}" for name in FIELDS if name in context)
        head, end, rest = super().format(record).partition("\n")
        text = _CONTROL.sub(lambda match: f"\\x{ord(match[0]):02x}", f"{head}{ids}{end}{rest}")
        return text.replace("\n", CONTINUED)


class OneObject(logging.Formatter):
    """Formatter that writes each record as one JSON object on one line, as `part` of the service."""

    def __init__(self, part: str) -> None:
        super().__init__()
        self._part = part

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as JSON, which escapes control characters."""
        known = get_contextvars() | vars(record)
        shown: dict[str, Any] = {
            "time": f"{datetime.fromtimestamp(record.created, UTC):%Y-%m-%dT%H:%M:%S.%fZ}",
            "level": record.levelname.lower(),
            "part": self._part,
            "logger": record.name,
            "message": record.getMessage(),
        }
        shown |= {name: known[name] for name in FIELDS if name in known}
        if record.exc_info:
            shown["exception"] = self.formatException(record.exc_info)
        return json.dumps(shown, default=str)


def begin(part: str, level: str, form: Format = "text") -> None:
    """Log to standard error from now on, as the named part of the service."""
    handler = logging.StreamHandler(sys.stderr)
    text = OneRecord(f"%(asctime)s %(levelname)s {part} %(name)s: %(message)s")
    handler.setFormatter(OneObject(part) if form == "json" else text)
    # replaces the handlers of the command line
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # people look for the address that is printed, not for every request; collectors get all
    for_people = form == "text" and level.upper() == "INFO"
    for name in ("app.access", "uvicorn.error"):
        logging.getLogger(name).setLevel(logging.WARNING if for_people else logging.NOTSET)
    logging.getLogger("alembic").setLevel(logging.WARNING)  # it logs every check of the schema
    engine = logging.getLogger("dbos")  # it adds a handler with its own format unless there is one
    engine.handlers, engine.propagate = [logging.NullHandler()], True
