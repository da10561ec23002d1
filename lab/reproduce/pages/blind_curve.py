"""Fig. 1: the curve of the blind benchmark, from what `lensmodel bench blind` left behind."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from lensmodel.core.errors import InvalidInputError


def collected(folder: Path, pictures: Path) -> dict[str, Any] | None:
    """Take tables and curves of a finished benchmark; None where there is none.

    Parameters
    ----------
    folder : Path
        Output folder of the benchmark.
    pictures : Path
        Where its curves are copied to.

    Returns
    -------
    dict or None
        `rows`, one a method and noise level; `settings`; `pictures`, names of the copies.

    Raises
    ------
    InvalidInputError
        If the stored benchmark cannot be read.
    """
    path = folder / "blind.json"
    if not path.exists():
        return None
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        settings, rows = stored["settings"], stored["summary"]
        kept = {name: settings[name] for name in ("noise", "half", "patch", "variant", "judge", "seed")}
    except (OSError, ValueError, KeyError) as error:
        raise InvalidInputError(f"{path} is no benchmark; run `lensmodel bench blind` again") from error
    pictures.mkdir(parents=True, exist_ok=True)
    curves = sorted(folder.glob("blind-er-*.png"))
    for curve in curves:
        shutil.copyfile(curve, pictures / f"fig1-{curve.name}")
    return {"rows": rows, "settings": kept, "pictures": [f"fig1-{curve.name}" for curve in curves]}
