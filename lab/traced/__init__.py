"""A second family of lenses whose PSF is known: published designs, ray-traced to all orders.

`designs` holds prescriptions (`prescription`), `rays` traces a copy of one, `wave` turns rays into a
pupil, `image` the pupil into a PSF, `lens` ties them together, `make` stores PSFs at nodes of the
field, and `grid` answers between them. Only `grid` works without the tracer, which is the extra `lab`.
`python -m lab.traced --help` makes grids.
"""

from lab.traced.grid import GridField, GridLens, read_grid

__all__ = ["GridField", "GridLens", "read_grid"]
