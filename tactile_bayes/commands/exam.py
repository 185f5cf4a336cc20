"""Options of the commands that show, carry and demonstrate exams: `demo`, `import`, `show`, `export`, `diagnose`."""

from __future__ import annotations

from inspect import cleandoc
from pathlib import Path
from typing import get_args

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands import options
from tactile_bayes.files.arrays_layout import GridOptions, Stated, layout_lines
from tactile_bayes.options import IdentityOptions, MapOptions, RecordOptions
from tactile_bayes.presets import CORRECTIONS, METHODS, ExportFormat

_FILE = options.FilePath()


@options.command("demo", "exam.demo_action")
@options.output_option("DIR", None, "Folder for the files.", default=Path("tactile-bayes-demo"), show_default=True)
@options.record_options(
    Settings, "method", type=click.Choice(METHODS[:3]), help="Method of the first estimate; see `estimate --help`."
)
@click.option("--force", is_flag=True, help="Overwrite the files of an earlier demo.")
def demo_command() -> None:
    """Run the main job on an embedded scan: map, estimate, and the report of a trial.

    The scan is simulated: a hard ball of 15 mm, one diameter deep in a breast of fat and gland, with the noise and
    tracker errors of a real examination. It is sized twice, by the default calibration and by the paper's own method,
    Markov chains through Eq 6, and both results are compared with the true size. The trial is synthetic. Each step is
    printed as the command that does it by hand.
    """


@options.command("import", "bring_in.import_action")
@click.argument("sources", metavar="SRC...", nargs=-1, type=_FILE)
@click.option("-o", "--output", type=_FILE, help="File to write: .mcap or .nc; of several SRC, the folder.")
@click.option(
    "--as",
    "kind",
    type=click.Choice(["scan", "map"]),
    help="Kind of SRC. Default: as the output's suffix says; a table or image without a scan's options is a map.",
)
@options.record_options(GridOptions)
@click.option(
    "--correct",
    "corrections",
    type=click.Choice(tuple(CORRECTIONS)),
    metavar="CORRECTION",
    multiple=True,
    help="Scan: correct the stated array, lever arm or quaternions, as `check` names it. "
    f"One of {', '.join(CORRECTIONS)}.",
)
@click.option(
    "--template",
    is_flag=True,
    help="Print a MAP.toml for --columns, with the arrays of SRC and guesses by their shapes.",
)
@options.path_option("--columns", "MAP.toml", "Scan: names of the arrays in SRC.")
@options.path_option("--poses", "FILE", "Scan: the tracker's poses, in a table of their own.")
@options.record_options(RecordOptions, "head_geometry", "array_calibration", "landmarks")
@options.record_options(Stated)
@options.SESSION
@options.FORCE
def import_command() -> None:
    """Import scans, grids and images from other programs.

    SRC holds frames (a scan): a file of arrays (.npz, .npy, MATLAB's .mat, HDF5), a text table with one row or one
    block of rows a frame, or a sequence metafile (.mha); a scan file to repair (what is intact is kept); or a grid of
    values (a map): a table, a grey .tif, .pgm or .png image, or with -o MAP.nc one array of .npz, .npy, .mat, HDF5 or
    netCDF. The first row of a grid has the lowest y and the first column the lowest x; pictures of the map show the
    first row on top, as the file reads.

    Frames are raw counts with a calibration, or pressures with --unit. What SRC does not hold stands in files beside
    it: --poses, --head-geometry, --array-calibration. A table becomes a scan where one of these is given or the output
    ends in .mcap. What is guessed is printed, and an option states it.

    Example: tactile-bayes import frames.csv --poses poses.csv --head-geometry head.json --unit kPa -o exam.mcap
    """


_ARRAYS_HEADING = "Arrays of a scan, in mm, kPa and s, for n frames and m poses:"
_OTHER_ARRAYS = (
    "Frames may also be called `frames`, and poses be homogeneous matrices, `pose_matrix` (m, 4, 4). Other names stand "
    "in MAP.toml."
)
_ARRAYS = "\n".join([_ARRAYS_HEADING, "", "\b", *layout_lines(), "", _OTHER_ARRAYS])
import_command.help = f"{cleandoc(import_command.help or '')}\n\n{_ARRAYS}"


@options.command("check", "exam.check_action")
@click.argument("scans", nargs=-1, required=True, metavar="SCAN...", type=_FILE)
@options.record_options(MapOptions, "pressure_window_kpa")
@options.output_option(
    "HEAD.json",
    None,
    "Write the scan's head with the day of this check, where the scan shows that it is right; for --head-geometry.",
)
@options.FORCE
def check_command() -> None:
    """Check that array, lever arm and quaternions of scans are as they are stated.

    Where frames overlap, they feel one breast. Other arrangements are tried (rows or columns reversed, an array turned
    or transposed, a lever arm inverted or left out, other orders of the quaternions), and that in which frames agree
    best is named with its odds. An empty breast shows nothing: check a scan of a phantom with a lump once.

    Example: tactile-bayes check scan.mcap
    """


@options.command("show", "show.show_action")
@click.argument("file", type=_FILE)
@options.JSON
def show_command() -> None:
    """Show what a file holds: schema, shape, units, quality, provenance.

    Knows scans, maps, posteriors, size calibrations, reports and the tables of trials and phantoms. Calibrations that
    come with the program are known by their names where no file is called so: solid, solid-mean, eq6, plane-strain.

    Example: tactile-bayes show map.nc
    """


@options.command("export", "pages.export_action")
@click.argument("files", metavar="FILE...", nargs=-1, type=_FILE)
@click.option("--to", required=True, type=click.Choice(get_args(ExportFormat)), help="Format to write.")
@options.output_option("OUT", None, "File to write; for dicom the folder of the files.")
@options.path_option(
    "--worklist",
    "ITEM",
    "Patient and study from a modality worklist item (.dcm or DICOM JSON), or from JSON of plain keys.",
)
@click.option("--patient-id-from-scan", is_flag=True, help="Use the scan's subject code as the patient ID.")
@options.record_options(IdentityOptions)
@options.path_option("--dictionary", "DICT.csv", "With csv: write the data dictionary of the REDCap form.")
@options.FORCE
def export_command() -> None:
    """Export maps and estimates as DICOM, FHIR, NRRD (3D Slicer) or CSV (REDCap).

    dicom takes a map, or a map and its estimate: values, picture and report, into a folder. fhir takes an estimate
    (what `estimate --json` prints), nrrd a map, csv one or more estimates. Files are told apart by their content; an
    estimate of another map is refused. Who was examined comes from options or a worklist and is never invented.

    Example: tactile-bayes export map.nc estimate.json --to dicom --study-date 2026-11-24T10:30 -o exam
    """


@options.command("diagnose", "exam.diagnose_action")
@click.argument("posterior", metavar="POST.nc", type=_FILE)
@options.figure_option("Draw densities and traces.", "--trace")
@options.figure_option("Draw the ranks of each chain's draws among all.", "--rank")
@options.figure_option("Draw the pairs of sizes, amplitude and widths.", "--corner")
@options.JSON
@options.FORCE
def diagnose_command() -> None:
    """Check the draws of a posterior: R-hat, effective draws and Monte-Carlo errors of every size and width.

    POST.nc is what `estimate -o` wrote. R-hat and effective draws compare chains, so they are of `--method ensemble`;
    weighted and independent draws are one chain, and their Pareto shape is shown instead.

    Example: tactile-bayes diagnose post.nc --trace trace.png --rank rank.png --corner corner.png
    """
