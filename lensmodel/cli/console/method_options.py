"""Options that name a method: apart from the others, because the list of methods takes SciPy."""

from __future__ import annotations

from typing import Annotated

import typer

from lensmodel import estimation
from lensmodel.estimation.patches import selectors

Estimator = Annotated[
    str, typer.Option(metavar="NAME", help=f"Blind estimator: {', '.join(estimation.estimators)}.")
]
Selector = Annotated[
    str, typer.Option(metavar="NAME", help=f"How patches of a photo are chosen: {', '.join(selectors)}.")
]
