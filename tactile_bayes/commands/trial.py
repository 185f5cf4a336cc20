"""Options of the commands on trials: `campaign`, `validate`, `plan`."""

from __future__ import annotations

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands import options
from tactile_bayes.options import CampaignOptions, PlanErrors, PlanOptions, TrialSettings

_FILE = options.FilePath()


@options.command("validate", "trial.validate_action")
@click.argument("trial", metavar="TRIAL.csv", type=_FILE)
@options.path_option("--excision", "EX.csv", "Sizes measured after excision.", required=True)
@options.path_option("--columns", "MAP.toml", "Layout of a wide TRIAL.csv: which column holds which reading.")
@options.record_options(TrialSettings, "intervals", "resamples", "seed", "error_ratio", "bayes")
@click.option(
    "-v",
    "--methods",
    "--verbose",
    "methods",
    is_flag=True,
    help="Also print lines, limits of agreement, repeatability, pairs and r squared.",
)
@options.JSON
@options.output_option("REPORT.json", "JSON", "Write the report as JSON to this file.")
@options.path_option("--html", "REPORT.html", "Write tables and figures as one self-contained page.", writes="HTML")
@options.path_option("--pdf", "REPORT.pdf", options.PRINTED)
@options.path_option("--protocol", "FILE.toml", "Pre-specified analysis; the report records its hash.")
@options.FORCE
def validate_command() -> None:
    """Compare sizes with excision: errors, lines, agreement, repeatability and calibration of each modality.

    TRIAL.csv has the columns patient, mass, modality, replicate, size_mm, status (detected, not_detected, not_done or
    blank) and optionally sd_mm, low_mm, high_mm, probability, reader, posterior, synthetic. EX.csv has patient, mass,
    ex_vivo_mm and optionally ex_vivo_second_mm, sd_mm, synthetic. Sizes are in mm.

    Example: tactile-bayes validate trial.csv --excision excision.csv -o report.json
    """


@options.command("plan", "trial.plan_action")
@options.record_options(PlanOptions, "patients", help="Number of patients, one mass each; may be repeated.")
@options.record_options(
    PlanOptions, "maps", help="Number of tactile maps per mass, 3 with --power or --precision; may be repeated."
)
@options.record_options(PlanOptions, "power", "precision")
@options.record_options(PlanErrors)
@options.path_option("--pilot", "TRIAL.csv", "Take the errors that no option gives from this trial; needs --excision.")
@options.path_option("--excision", "EX.csv", "Sizes measured after excision in the pilot.")
@options.record_options(PlanOptions, "against", "trials", "seed", "workers")
@options.JSON
@options.output_option("PLAN.json", "JSON", "Write the plan as JSON to this file.")
@options.figure_option("Draw power against the number of patients.")
@options.FORCE
def plan_command() -> None:
    """Plan a trial: how many patients, how many maps of a mass, by simulation.

    With --power or --precision the answer is a number of patients, by simulated designs about it. Each design is
    simulated with log-normal errors. Power is the share of trials in which the tactile percent error is the smaller one
    and a sign-flip test by patient finds p < 0.05. SDs are of ln size: 0.15 is about 15 %.

    Example: tactile-bayes plan --power 0.9 --maps 3 --figure plan.png
    """


@click.group("campaign", cls=options.CommandGroup)
def campaign_command() -> None:
    """From a folder of exams to the trial's report, in one resumable run."""


@options.command("init", "campaign.campaign_init_action", within=campaign_command)
@click.argument("folder", metavar="FOLDER", type=options.FilePath(addresses=True))
@options.output_option("EXAMS.csv", "CSV", "Where to write the table.", guarded=False, required=True)
@click.option(
    "--names",
    metavar="PATTERN",
    help="Pattern of the files' names: '{patient}_{visit}_{exam}.npz', also with {mass}, {side}, {reader} and {date}, "
    "* for anything, and / for folders.",
)
@click.option("--add", is_flag=True, help="Keep the rows of an EXAMS.csv that is there, and add those of other files.")
@options.FORCE
def campaign_init_command() -> None:
    """Write the table of exams from a folder of scans and what they carry.

    FOLDER may be one in an object store, as s3://bucket/scans; the maps in it are passed over.

    Patient, side and reader are the `subject`, `side` and `examiner` that `record` wrote into each scan; visit and mass
    are its `visit` and `mass`, or 1. Exams of a mass are numbered in the order of their file names. Cells that no scan
    fills stay blank. Copies, and maps of scans that are listed, are left out and named. With --names these facts are
    also read from the files' names; files that do not follow the pattern, or contradict their name, are left out and
    listed.

    Example: tactile-bayes campaign init scans -o exams.csv
    """


@options.command("run", "campaign.campaign_run_action", within=campaign_command)
@click.argument("exams", metavar="EXAMS.csv", type=_FILE)
@options.output_option("DIR", None, "Folder for all files.", required=True)
@options.record_options(CampaignOptions, "excision", "columns", "protocol")
@options.record_options(Settings, "method", help="As `estimate`.")
@options.record_options(
    Settings, "size_calibration", metavar="NAME|SIZE.json", help="As `estimate`, unless a row names its own."
)
@options.record_options(Settings, "settings_file", help="Priors and more, as `estimate`.")
@options.record_options(CampaignOptions, "normalise", "match_mm")
@click.option(
    "--repeatability",
    type=options.FilePath(),
    metavar="none|SITE.json",
    help="Spread between exams of one mass: a file as for `estimate`, or none (two intervals: the page leads with that "
    "for patients, the tables hold the narrower). Default: learned from this campaign's repeats, where 5 masses "
    "have them.",
)
@options.record_options(Settings, "seed")
@options.record_options(CampaignOptions, "figures", "dry_run", "copy_to", "workers", "scheduler")
def campaign_run_command() -> None:
    """Map, estimate and pool the exams of a table, and report the trial.

    DIR gets a folder for each exam and each pooled mass, exams_done.csv, failures.csv, trial.csv (which `validate`
    takes), index.html (a row for each mass, with its visits, size, change and exams) and, with --excision,
    report.html and report.json. Every exam has a page, exam.html. Masses with several visits are compared
    (growth.csv, a page each), and the report is of the last visit before excision. Where 5 masses have several
    exams at one visit, the spread between exams is learned from them and every size is by it. An exam's fault is
    its row in failures.csv; the others go on. The same call again goes on where it was interrupted, and does again
    what depends on a file or setting that changed, and what failed.

    Example: tactile-bayes campaign run exams.csv --excision excision.csv -o out
    """
