"""What must hold in the tables at every moment, whichever process dies when; for tests and for operators.

Each check is one query that returns the public ids of the rows which break it: none on a sound installation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from sqlalchemy import text
from sqlalchemy.orm import Session

MOST: Final = 1000  # findings of one check at most (chosen): nobody reads more


def broken(session: Session, query: str) -> Sequence[str]:
    """Return the public ids of what breaks the invariant of a query."""
    return list(session.scalars(text(f"{query} LIMIT {MOST}")))


# What must hold, and the query of what breaks it, by a short name
INVARIANTS: Final[Mapping[str, tuple[str, str]]] = {
    "versions": (
        "the version of a lens is the number of its events",
        """
        SELECT public_id FROM lens
        WHERE version <> (SELECT count(*) FROM calibration_event e WHERE e.lens_id = lens.id)
            OR version <> (SELECT coalesce(max(version), 0) FROM calibration_event e WHERE lens_id = lens.id)
        """,
    ),
    "totals": (
        "lenses count their samples and photos rightly",
        """
        SELECT public_id FROM lens LEFT JOIN (
            SELECT lens_id, count(*) AS samples, count(DISTINCT photo_id) AS photos
            FROM psf_sample WHERE lens_id IS NOT NULL GROUP BY lens_id
        ) AS counted ON counted.lens_id = lens.id
        WHERE sample_count <> coalesce(samples, 0) OR photo_count <> coalesce(photos, 0)""",
    ),
    "joined": (
        "each counted photo joined its lens by an event",
        """
        SELECT public_id FROM photo WHERE state = 'counted' AND NOT EXISTS (
            SELECT 1 FROM calibration_event e WHERE e.lens_id = photo.lens_id
            AND e.photo_public_id = photo.public_id AND e.kind IN ('photo_added', 'photo_included')
        )""",
    ),
    "counted samples": (
        "exactly the samples of counted photos count",
        """
        SELECT DISTINCT photo.public_id FROM photo
        JOIN psf_sample ON psf_sample.photo_id = photo.id
        JOIN patch ON patch.id = psf_sample.patch_id
        LEFT JOIN lens ON lens.id = psf_sample.lens_id
        WHERE CASE WHEN photo.state = 'counted' AND patch.epoch = photo.epoch
            THEN psf_sample.lens_id IS NULL OR psf_sample.lens_id <> photo.lens_id
                OR psf_sample.version_added IS NULL OR psf_sample.version_added > lens.version
            ELSE psf_sample.lens_id IS NOT NULL END""",
    ),
    "samples": (
        "patches are done exactly if they have samples",
        """
        SELECT DISTINCT photo.public_id FROM photo JOIN patch ON patch.photo_id = photo.id
        WHERE (patch.state = 'done') <> EXISTS (
            SELECT 1 FROM psf_sample WHERE psf_sample.patch_id = patch.id
        )""",
    ),
    "progress": (
        "photos count their patches rightly",
        """
        SELECT public_id FROM photo LEFT JOIN (
            SELECT photo_id, epoch,
                sum(CASE WHEN state IN ('done', 'failed') THEN 1 ELSE 0 END) AS done,
                sum(CASE WHEN state = 'rejected' THEN 1 ELSE 0 END) AS rejected,
                sum(CASE WHEN state <> 'rejected' THEN 1 ELSE 0 END) AS used
            FROM patch GROUP BY photo_id, epoch
        ) AS counted ON counted.photo_id = photo.id AND counted.epoch = photo.epoch
        WHERE state IN ('estimating', 'counted', 'excluded') AND (
            patches_done <> coalesce(done, 0) OR patches_total <> coalesce(used, 0)
            OR patches_rejected <> coalesce(rejected, 0) + windows_rejected
        )""",
    ),
    "endings": (
        "counted photos have a lens, failed ones a reason",
        """
        SELECT public_id FROM photo WHERE (state = 'counted' AND (lens_id IS NULL OR finished_at IS NULL))
            OR (state = 'failed' AND (error_code IS NULL OR finished_at IS NULL))""",
    ),
    "owners of lenses": (
        "photos teach lenses of their owner",
        """
        SELECT photo.public_id FROM photo JOIN lens ON lens.id = photo.lens_id
        WHERE lens.owner_id <> photo.owner_id""",
    ),
    "owners of photos": (
        "corrections are of photos of their owner",
        """
        SELECT correction.public_id FROM correction JOIN photo ON photo.id = correction.photo_id
        WHERE correction.owner_id <> photo.owner_id""",
    ),
}
