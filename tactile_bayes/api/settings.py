"""Settings of `estimate` and of `compare`, each with its default and range."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from tactile_bayes.declarations import Meta, extra_of, field_types, subrecord
from tactile_bayes.errors import UsageError
from tactile_bayes.options import IN_FILE, PRIORS, FitSettings, cli_meta
from tactile_bayes.presets import INTERVAL

if TYPE_CHECKING:
    from tactile_bayes.size.pooling import Calibration, Repeatability
else:
    Calibration = Repeatability = Any  # which take numpy to load


# --- Settings of `estimate`, shared by the command line, Python and batches.

GIVEN: Final = "given in Python"  #: Name of a calibration that is in no file.


class Settings(FitSettings, kw_only=True):
    """Settings of `estimate`; picklable, so that worker processes can receive them."""

    size_calibration: Annotated[
        str | Calibration | None,
        cli_meta("solid|eq6|solid-mean|plane-strain|none|SIZE.json"),
        "Calibration from widths to sizes: a shipped one, your own file, or none (widths only). Default: solid, or "
        "solid-mean for maps of frames divided by their means; eq6 is the paper's Eq 6 over such bodies.",
    ] = None
    seed: Annotated[int, Meta(ge=0), "Random seed."] = 1
    interval: Annotated[float, Meta(gt=0, lt=1), "Probability of the intervals."] = INTERVAL
    between_map_sd: Annotated[
        Annotated[float, Meta(ge=0, le=2)] | None,
        IN_FILE,
        "SD of ln size between maps of one mass, taken as known. Default: one interval for exams as the calibration's "
        "(0.025 if solid), one as the paper's (0.15)",
    ] = None
    repeatability: Annotated[
        Repeatability | None,
        cli_meta("SITE.json"),
        "Spread between exams of one mass at this site, from `calibrate repeatability`: sizes then have one interval, "
        "for any exam there. Default: two, for exams as the paper's and as simulated ones.",
    ] = None
    known: Annotated[
        tuple[tuple[str, float], ...],
        cli_meta("NAME VALUE"),
        "Known property of the body: seat (0 centred on the gland's edge, 1.2 clear of it), depth_mm, stiffness_ratio, "
        "fat_kpa, gland_ratio or thickness_mm.",
    ] = ()
    checkpoint: Annotated[
        Path | None,
        IN_FILE,
        "File that MCMC (method ensemble) saves its state in and resumes from; relative to the settings file",
    ] = None
    settings_file: Annotated[
        Path | None,
        cli_meta("FILE.toml", option="settings"),
        "Priors and rarely used options: background, fit_radius_mm, noise, max_steps... (settings.schema.json).",
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.between_map_sd is not None and self.repeatability is not None:
            raise UsageError("between_map_sd states the spread that the repeatability has learned; give one of them")
        names = [name for name, _ in self.known]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise UsageError(f"{twice} is known twice; give it one value")
        if self.repeatability is not None and self.size_calibration == "none":
            raise UsageError("a repeatability is for sizes; leave it out, or name a size calibration")

    @property
    def calibration_name(self) -> str | None:
        """Name or path of the calibration; None where none was named."""
        calibration = self.size_calibration
        return calibration if calibration is None or isinstance(calibration, str) else GIVEN

    def recorded(self, **actual: Any) -> dict[str, Any]:
        """Plain data of all settings but the seed, for a provenance; `actual` values replace those asked for."""
        first = dict.fromkeys(("size_calibration", "method", "interval"))
        plain: dict[str, Any] = first | {name: actual.get(name, getattr(self, name)) for name in self.__struct_fields__}
        del plain["seed"], plain["settings_file"]
        plain["size_calibration"] = actual.get("size_calibration", self.calibration_name)
        plain["centre_mm"] = None if self.centre_mm is None else list(self.centre_mm)
        plain["known"] = dict(self.known)
        plain["checkpoint"] = None if self.checkpoint is None else self.checkpoint.name
        if self.repeatability is None:
            del plain["repeatability"]
        else:
            plain["repeatability"] = self.repeatability.as_dict()
        return plain


SettingsFile: Final = subrecord(
    Settings,
    [*PRIORS, *(name for name, kind in field_types(Settings).items() if extra_of(kind).get("file"))],
    "Settings of `estimate --settings`: priors and rarely used options; a missing key keeps its default.",
)
"""Record of the file."""


def read_settings(path: Path) -> dict[str, Any]:
    """Read a settings file: values by the names of `Settings`."""
    from tactile_bayes.files.documents import load_toml, parse_record

    document = load_toml(path, way_out="see settings.schema.json")
    parsed = parse_record(document, SettingsFile, path=path)
    values = {name: getattr(parsed, name) for name in document}
    if "checkpoint" in values:
        values["checkpoint"] = path.parent / values["checkpoint"]
    return values | {"settings_file": path}


def refuse_checkpoint(settings: Settings) -> None:
    """Refuse a checkpoint where several maps are estimated: all would resume from one state."""
    if settings.checkpoint is not None:
        raise UsageError("a checkpoint is of one map; give one map, or leave checkpoint out of the settings")


# --- Times of the visits of a comparison.


def days_from_first(days: Sequence[float] | None, dates: Sequence[str] | None) -> tuple[float, ...] | None:
    """Days of all visits from the first, from the later ones' days or from all dates; None for neither."""
    if days is not None and dates is not None:
        raise UsageError("days and dates both say when the visits were; give one of them")
    if dates is None:
        return None if days is None else (0.0, *days)
    parsed = []
    for text in dates:
        try:
            parsed.append(date.fromisoformat(str(text).strip()))
        except ValueError:
            raise UsageError(f"{str(text).strip()!r} is no date; give year-month-day, such as 2026-03-01") from None
    return tuple(float((one - parsed[0]).days) for one in parsed)


def split_dates(text: str | None) -> tuple[str, ...]:
    """Split dates at commas, such as 2026-01-15,2026-04-20; None gives no date."""
    return () if text is None else tuple(one.strip() for one in text.split(","))
