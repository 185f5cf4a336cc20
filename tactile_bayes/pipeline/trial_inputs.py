"""Input of `validate` and `plan`: the tables of a trial, tidy or wide, and the estimates that they name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactile_bayes.files.tables import Sheet, Table
    from tactile_bayes.trial.readings import MassKey, Reading
    from tactile_bayes.trial.visits import OtherVisits


@dataclass(frozen=True, slots=True)
class TrialInputs:
    """Input of a trial's analysis, with every file read, by role.

    The readings are those of each mass's last visit before excision; `other_visits` counts what that leaves out.
    """

    readings: list[Reading]
    other_visits: OtherVisits
    ex_vivo_mm: Mapping[MassKey, float]
    ex_vivo_sd_mm: Mapping[MassKey, float | None]
    files: dict[str, Path]


def load_trial(
    trial: Path | Sheet, excision: Path | Sheet, columns: Path | None, *, tidy_trial: bool = False
) -> TrialInputs:
    """Read and check both tables.

    Parameters
    ----------
    columns
        The mapping file of a wide table; None where both are tidy. One without ``[[reading]]`` is for the excision
        sizes alone.
    tidy_trial
        Whether the trial is tidy whatever the mapping holds.
    """
    from tactile_bayes.files.column_map import read_mapping, read_wide
    from tactile_bayes.files.size_posterior import fill_from_posteriors
    from tactile_bayes.files.tables import Sheet, check_references, read_table
    from tactile_bayes.trial.readings import readings_from_columns
    from tactile_bayes.trial.visits import at_excision

    sizes = read_excision(excision, columns)
    if columns is None or tidy_trial or isinstance(trial, Sheet) or "reading" not in read_mapping(columns):
        table = read_table(trial, "trial.table.json")
    else:
        table = read_wide(trial, columns)
    check_references(table, "trial.table.json", targets={"excision": sizes})
    filled, posteriors = fill_from_posteriors(table.columns, table.path.parent, fault=table.error)
    keys = list(zip(sizes.columns["patient"], sizes.columns["mass"], strict=True))
    readings = readings_from_columns(filled, fault=table.error)
    excised_on = dict(zip(keys, sizes.columns["date"], strict=True))
    analysed, other_visits = at_excision(readings, excised_on, fault=table.error)
    given = {"trial": trial, "excision": excision, "columns": columns}
    files = {role: path for role, path in given.items() if isinstance(path, Path)}
    return TrialInputs(
        readings=analysed,
        other_visits=other_visits,
        ex_vivo_mm=dict(zip(keys, sizes.columns["ex_vivo_mm"], strict=True)),
        ex_vivo_sd_mm=dict(zip(keys, sizes.columns["sd_mm"], strict=True)),
        files=files | {f"posterior_{number}": path for number, path in enumerate(posteriors, start=1)},
    )


def read_excision(excision: Path | Sheet, columns: Path | None) -> Table:
    """Sizes after excision: from a wide table where the mapping has ``[excision]``, otherwise from a tidy one."""
    from tactile_bayes.files.column_map import read_mapping, read_wide_excision
    from tactile_bayes.files.tables import read_table

    if columns is None or not isinstance(excision, Path) or "excision" not in read_mapping(columns):
        return read_table(excision, "excision.table.json")
    return read_wide_excision(excision, columns)
