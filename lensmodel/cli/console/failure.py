"""How a command ends when it cannot do what was asked."""

from __future__ import annotations

from lensmodel.core.errors import InvalidInputError


class UsageError(InvalidInputError):
    """The command was called wrongly: nothing was begun; exit status 2."""


class InterruptedByUser(BaseException):
    """Ctrl-C or SIGTERM. Carries the number of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
