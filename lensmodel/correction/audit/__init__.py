"""Audit of a correction against facts that need no truth; what fails is mixed back towards the original."""

from lensmodel.correction.audit.check import Evidence, Finding, TileAudit
from lensmodel.correction.audit.findings import HELD, AuditReport, Place, ZoneAudit, pooled
from lensmodel.correction.audit.tile import CHECKS, audit_tile, held_back
from lensmodel.correction.audit.whole_photo import PhotoAudit, audit_photo

__all__ = [
    "CHECKS",
    "HELD",
    "AuditReport",
    "Evidence",
    "Finding",
    "PhotoAudit",
    "Place",
    "TileAudit",
    "ZoneAudit",
    "audit_photo",
    "audit_tile",
    "held_back",
    "pooled",
]
