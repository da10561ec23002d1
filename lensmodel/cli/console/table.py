"""Tables of plain text: columns in line in a terminal, words that `grep` and `awk` find in a pipe."""

from __future__ import annotations

from collections.abc import Container, Sequence


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Container[int] = ()) -> str:
    """Write rows under a head, columns two blanks apart; those in `numbers` are set to the right."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = [head, ["-" * width for width in widths], *rows]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i in numbers else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
