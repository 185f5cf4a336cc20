"""Files that other systems take: DICOM, FHIR, NRRD and the CSV of a REDCap project."""
