"""Audit of a correction against facts that need no truth; what fails is mixed back towards the original."""

from lensmodel.audit.base import Evidence, Finding, TileAudit
from lensmodel.audit.tile import CHECKS, audit_tile, held_back

__all__ = ["CHECKS", "Evidence", "Finding", "TileAudit", "audit_tile", "held_back"]
