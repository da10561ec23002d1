"""Logging of the service's processes: each record begins a line, whatever its text contains.

Text and JSON (`LENS_LOG_FORMAT=json`) both name the request, the job and the photo of a record.
"""

from __future__ import annotations

import logging
import re
import sys
from typing import Final, Literal, TypeAlias

from structlog import contextvars, processors, stdlib
from structlog.typing import EventDict

Format: TypeAlias = Literal["text", "json"]

# Prefix of each further line of a record: no text from outside can imitate a record
CONTINUED: Final = "\n    | "
# Fields of a record besides its text; the same names in the context of a thread and in `extra`
FIELDS: Final = (
    *("request_id", "job_id", "photo_id", "lens_id", "correction_id", "method", "path", "status", "ms"),
)
_BASIC: Final = ("time", "level", "logger", "message", "exception")
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


class OneRecord(logging.Formatter):
    """Formatter that escapes control characters: neither lines nor terminal sequences can be forged."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a record with the ids of its context and control characters escaped."""
        context = contextvars.get_contextvars()
        ids = "".join(f" {name}={context[name]}" for name in FIELDS if name in context)
        head, end, rest = super().format(record).partition("\n")
        text = _CONTROL.sub(lambda match: f"\\x{ord(match[0]):02x}", f"{head}{ids}{end}{rest}")
        return text.replace("\n", CONTINUED)


def one_object(part: str) -> logging.Formatter:
    """Return a formatter that writes each record as one JSON object on one line, as `part` of the service."""

    def shown(logger: object, method: str, record: EventDict) -> EventDict:
        del logger, method
        return {"part": part, **{name: record[name] for name in (*_BASIC, *FIELDS) if name in record}}

    return stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            contextvars.merge_contextvars,
            stdlib.ExtraAdder(FIELDS),
            stdlib.add_log_level,
            stdlib.add_logger_name,
            processors.TimeStamper(fmt="iso", utc=True, key="time"),
        ],
        processors=[
            processors.format_exc_info,
            processors.EventRenamer("message"),
            shown,
            processors.JSONRenderer(),
        ],
    )


def begin(part: str, level: str, form: Format = "text") -> None:
    """Log to standard error from now on, as the named part of the service."""
    handler = logging.StreamHandler(sys.stderr)
    text = OneRecord(f"%(asctime)s %(levelname)s {part} %(name)s: %(message)s")
    handler.setFormatter(one_object(part) if form == "json" else text)
    # replaces the handlers of the command line
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # people look for the address that is printed, not for every request; collectors get all
    for_people = form == "text" and level.upper() == "INFO"
    for name in ("app.access", "uvicorn.error"):
        logging.getLogger(name).setLevel(logging.WARNING if for_people else logging.NOTSET)
    logging.getLogger("alembic").setLevel(logging.WARNING)  # it logs every check of the schema
    engine = logging.getLogger("dbos")  # it adds a handler with its own format unless there is one
    engine.handlers, engine.propagate = [logging.NullHandler()], True
