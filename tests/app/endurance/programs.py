"""What the programs of this folder share: the helpers of the tests, and how they are asked."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "stand_ins")]


def wishes(about: str | None, **options: Any) -> argparse.Namespace:
    """Return the options of the command line, of the types of what holds without them."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    for name, usual in options.items():
        flag = f"--{name.replace('_', '-')}"
        if usual is False:
            parser.add_argument(flag, action="store_true")
        else:
            parser.add_argument(flag, type=type(usual), default=usual)
    return parser.parse_args()
