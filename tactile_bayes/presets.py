"""The named numbers of the paper and of this program, each with its source."""

from __future__ import annotations

from typing import Final, Literal, get_args

RESEARCH_USE: Final = "Research use only: not a diagnostic device."

# Wellman & Howe (1999), section 2.1 and figure 1.
HEAD_ROWS: Final = 16  # across the head, x of the scanhead frame
HEAD_COLUMNS: Final = 26  # along the head, y of the scanhead frame
HEAD_PITCH_MM: Final = 1.5
PRESSURE_RANGE_KPA: Final = (0.0, 34.0)

# "Anticipated user-applied pressures", section 2.1; the paper gives the gate no number of its own.
PRESSURE_WINDOW_KPA: Final = (5.0, 14.0)

# kPa in one of each unit of pressure: the inch-pound and the technical definitions, exact or to 7 digits.
KPA_PER_UNIT: Final = {"kPa": 1.0, "Pa": 0.001, "psi": 6.894757, "mmHg": 0.1333224, "N/cm2": 10.0}

# mm in one of each unit of length.
MM_PER_UNIT: Final = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "inch": 25.4, "um": 1e-3}

# The head as simulated: an arc with rounded shoulders (shared design notes; the paper: "nearly a circular cylinder").
HEAD_RADIUS_MM: Final = 35.0
SHOULDER_MM: Final = 3.0
# Where the shoulders of the head's section lie: cut into the sensing width, or around it (docs/decisions/0075).
SHOULDERS_INSIDE: Final = "shoulders-inside"
SHOULDERS_OUTSIDE: Final = "shoulders-outside"
HEADS: Final = (SHOULDERS_INSIDE, SHOULDERS_OUTSIDE)

# The body as simulated, section 2.2: fat, gland ten times as stiff, a rigid chest wall; the pressure on it.
FAT_KPA: Final = 5.0
GLAND_RATIO: Final = 10.0
POISSON: Final = 0.495
THICKNESS_MM: Final = 70.0
MEAN_KPA: Final = 9.5

# E2/E1 from which the paper takes a lump for hard: widths change by less than 5 % from there on (section 2.4).
LEAST_HARD_RATIO: Final = 8.0

CELL_MM: Final = 1.0
CELL_PER_SIGMA: Final = 0.75  #: A cell wider than this share of the narrower sigma is called coarse in the report.
# Radius about the lump's centre inside which the map is fitted, where no size calibration says otherwise.
FIT_RADIUS_MM: Final = 20.0

# Figures of a map: how pressure is spread over the head where it feels no lump, see `mapping.profile`.
HEAD_PROFILE: Final = ("head_profile_x2", "head_profile_y2", "head_profile_y4")

# Figures of a map: SD of a frame's place along the plane's axes and the sides of the array there, mm, and how many
# frames with an error of their own felt a cell for each reading in it, see `mapping.profile`.
POSE_NOISE: Final = ("pose_noise_x_mm", "pose_noise_y_mm", "frame_side_x_mm", "frame_side_y_mm", "frames_per_reading")

RECORDING_KEYS: Final = "keys: n sternal notch, x xiphoid, p nipple, space start, q stop"

Normalise = Literal["mean", "gain", "none"]
NORMALISE: Final[tuple[Normalise, ...]] = get_args(Normalise)
# See docs/decisions/0065; the paper divides by the mean.
DEFAULT_NORMALISE: Final[Normalise] = "gain"
TrackerProtocol = Literal["open", "fastrak", "fastrak-ascii", "liberty", "liberty-ascii", "bird", "igtlink", "ndi"]
ExportFormat = Literal["dicom", "fhir", "nrrd", "csv"]
Method = Literal["optimise", "laplace", "importance", "ensemble"]
METHODS: Final[tuple[Method, ...]] = get_args(Method)
Noise = Literal["independent", "field"]
Background = Literal["fixed", "free"]
Rotation = Literal["auto", "off", "on"]
SceneName = Literal["auto", "none", "round", "ellipse", "rotated", "second-lump", "rib"]
INTERVAL: Final = 0.95
HELD_OUT_PROBABILITY: Final = 0.9  #: Probability of the intervals whose coverage of held-out bodies is tested.
# Along each axis, of a map's noise field. Fewer are faster; what is finer than they resolve counts as independent.
# A narrow bump gets more than these by itself, up to the second number.
FIELD_COSINES: Final = 18
FINE_FIELD_COSINES: Final = 30
MOST_FIELD_COSINES: Final = 40

MOST_VISITS: Final = 10  #: Visits of one comparison.
REGISTRATION_MM: Final = 5.0
"""SD each way of a mass's place in the patient between two visits; an assumption, see record 0115."""

MATCH_MM: Final = 15.0
"""Default distance for matching a mass by its place: half the distance at which two masses are told apart."""
VIRIDIS: Final = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""Colours from low to high: five of viridis (van der Walt & Smith 2015), which also read in grey."""
CORRECTIONS: Final = {
    "rows-reversed": "the array's rows run backwards",
    "columns-reversed": "the array's columns run backwards",
    "half-turn": "the array is turned by 180 degrees",
    "quarter-turn": "the array is turned by 90 degrees against the tracker, as if its lever arm were left out",
    "quarter-turn-back": "the array is turned by -90 degrees against the tracker, as if its lever arm were left out",
    "transposed": "frames were reshaped where they should be transposed",
    "lever-inverse": "the lever arm is that from the head to the tracker",
    "lever-none": "the poses are those of the head already",
    "scalar-last": "the quaternions are scalar last",
    "inverse-rotation": "the quaternions are of the inverse rotation",
}
"""Faults of a scan's arrangement, in words, by the correction at its import."""
