"""Audit of a correction against facts that need no truth; what fails is mixed back towards the original."""

from lensmodel.audit.base import Evidence, Finding, TileAudit
from lensmodel.audit.photo import PhotoAudit, audit_photo
from lensmodel.audit.report import HELD, AuditReport, Place, ZoneAudit, pooled
from lensmodel.audit.tile import CHECKS, audit_tile, held_back

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
