"""Progress of a call in a terminal or a notebook, on standard error."""

from __future__ import annotations

import sys


class ProgressLine:
    """One line, which a terminal shows anew at each step; a notebook gets whole lines only.

    Where standard error is neither, nothing is written.
    """

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._shown = self._terminal or "ipykernel" in sys.modules
        self._width = 0

    def say(self, text: str) -> None:
        """Show a step in place of the last one."""
        if self._terminal:
            sys.stderr.write(f"\r{text:<{self._width}}")
            sys.stderr.flush()
            self._width = len(text)

    def end(self, text: str) -> None:
        """Show a line that stays."""
        if self._shown:
            sys.stderr.write(f"{chr(13) if self._terminal else ''}{text:<{self._width}}\n")
            self._width = 0
