"""Codes and identifiers of the standards."""

from __future__ import annotations

import uuid
from typing import Final, NamedTuple

# --- Unique identifiers that follow from content: equal content, equal identifier, on every machine.

_ROOT: Final = uuid.UUID("5d0f8a6c-54d1-5c0e-9a2b-3f5a3c1c9d47")
"""Name space of this program's identifiers; it must never change."""


def content_uuid(role: str, *parts: str) -> uuid.UUID:
    """UUID of version 5 (RFC 9562) of a role and of what identifies the content in it, such as digests."""
    return uuid.uuid5(_ROOT, "\x1f".join((role, *parts)))


def content_uid(role: str, *parts: str) -> str:
    """DICOM unique identifier ``2.25.`` and the number of `content_uuid` (PS3.5 B.2); at most 44 characters."""
    return f"2.25.{content_uuid(role, *parts).int}"


# --- Coded concepts of the exports, with where each comes from.
#
# Codes of SNOMED CT and of DICOM are those that PS3.16 of the DICOM standard lists (the context groups are named
# beside them). What no list has is in a coding scheme of this program's own, which every file declares.


class Code(NamedTuple):
    """A concept: value, coding scheme by its DICOM designator, meaning in words."""

    value: str
    scheme: str
    meaning: str


OWN_SCHEME: Final = "99TACTILEBAYES"
OWN_SCHEME_NAME: Final = "Concepts of tactile_bayes that no published list has"
OWN_SCHEME_UID: Final = content_uid("coding scheme", "1")
FHIR_SYSTEMS: Final = {
    "SCT": "http://snomed.info/sct",
    "DCM": "http://dicom.nema.org/resources/ontology/DCM",
    OWN_SCHEME: f"urn:oid:{OWN_SCHEME_UID}",
}
"""Scheme -> code system of FHIR (PS3.16 chapter 8; SNOMED CT's of HL7's terminology page)."""

# CID 7469 Generic Intensity and Size Measurements
LONG_AXIS: Final = Code("103339001", "SCT", "Long axis")
SHORT_AXIS: Final = Code("103340004", "SCT", "Short axis")
# CID 7464 General Region of Interest Measurement Modifiers
MEDIAN: Final = Code("373099004", "SCT", "Median")
# CID 225 Measurement Uncertainty
UPPER_RANGE: Final = Code("371886008", "SCT", "+, range of upper measurement uncertainty")
LOWER_RANGE: Final = Code("371885007", "SCT", "-, range of lower measurement uncertainty")
# CID 6055 Breast Clinical Finding or Indicated Problem
BREAST_LUMP: Final = Code("89164003", "SCT", "Breast lump")
# CID 4031 Common Anatomic Regions, CID 6022 Side, CID 244 Laterality
BREAST: Final = Code("76752008", "SCT", "Breast")
SIDES: Final = {"left": Code("7771000", "SCT", "Left"), "right": Code("24028007", "SCT", "Right")}
BREASTS: Final = {"left": Code("80248007", "SCT", "Left breast"), "right": Code("73056007", "SCT", "Right breast")}
# TID 4015 and CID 6048: 0 to 100 %, by a device
CERTAINTY: Final = Code("111012", "DCM", "Certainty of Finding")
COMMENT: Final = Code("121106", "DCM", "Comment")
REPORT_TITLE: Final = Code("126000", "DCM", "Imaging Measurement Report")

EXAM: Final = Code("tactile-imaging", OWN_SCHEME, "Tactile imaging of the breast")
METHOD: Final = Code("tactile-size", OWN_SCHEME, "Size of a lump from a tactile map by a calibration")
RELATIVE_PRESSURE: Final = Code("rel-pressure", OWN_SCHEME, "Pressure over the level beside a lump")
PRESSURE: Final = Code("mean-pressure", OWN_SCHEME, "Mean pressure of the readings in a cell")
INTERVAL_LOW: Final = Code("interval-low", OWN_SCHEME, "Lower end of the credible interval")
INTERVAL_HIGH: Final = Code("interval-high", OWN_SCHEME, "Upper end of the credible interval")
INTERVAL_PROBABILITY: Final = Code("interval-prob", OWN_SCHEME, "Probability of the credible interval")
OUTCOME: Final = Code("outcome", OWN_SCHEME, "Outcome of the estimate")
NOT_DETECTED: Final = Code("no-lump-shown", OWN_SCHEME, "The map shows no lump that can be measured")
NOT_SIZED: Final = Code("not-sized", OWN_SCHEME, "A lump may be there, without a size")
SIZED: Final = Code("sized", OWN_SCHEME, "Lump with a size")
