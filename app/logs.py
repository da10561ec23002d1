"""How the service's processes log: one record begins one line, whatever its text holds."""

from __future__ import annotations

import logging
import re
import sys
from typing import Final

CONTINUED: Final = "\n    | "
"""Before each further line of a record: no text from outside can look like a record of its own."""

_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


class OneRecord(logging.Formatter):
    """Writes a record so that neither a new line, nor an escape sequence for the terminal can be forged."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a record, its control characters made visible."""
        text = _CONTROL.sub(lambda found: f"\\x{ord(found[0]):02x}", super().format(record))
        return text.replace("\n", CONTINUED)


def begin(part: str, level: str) -> None:
    """Log to the standard error from now on, as the named part of the service."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneRecord(f"%(asctime)s %(levelname)s {part} %(name)s: %(message)s"))
    # in place of what the command line set up
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    logging.getLogger("alembic").setLevel(logging.WARNING)  # it tells of every look at the schema
