"""The tasks of the service, with reports of lenses that take a second instead of twenty.

Each version of each lens has one made, whether a test asks for it or not.
"""

from __future__ import annotations

from functools import partial

from app.jobs import tasks
from lensmodel.report.lens_report import lens_report

tasks.lens_report = partial(lens_report, rows=5, size=15)  # instead of 7 and 31

TASKS = tasks.TASKS
