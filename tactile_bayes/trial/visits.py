"""Which readings of a trial belong to the excision: those of the last visit on or before it."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import date
from itertools import pairwise

from tactile_bayes.declarations import Record, field
from tactile_bayes.trial.readings import CellFault, MassKey, Reading

_NUMBERED = re.compile(r"(\D*)([0-9]{1,9})")
Row = tuple[int, Reading]


class OtherVisits(Record):
    """Readings that a trial's analysis leaves out because they are of other visits than the excision's."""

    masses: int = 0
    """How many masses were read at several visits."""
    earlier: int = 0
    later: int = 0
    """`earlier`, `later`: Readings at visits before the last one, and after the excision."""
    only_there: Mapping[str, int] = field(default_factory=dict)
    """By modality, masses that it read at other visits alone."""

    def lines(self) -> list[str]:
        """What was left out, in words; empty where nothing was."""
        if not self.earlier and not self.later:
            return []
        parts = [f"{self.earlier} of earlier visits"] if self.earlier else []
        parts += [f"{self.later} after excision"] if self.later else []
        masses = "1 mass was" if self.masses == 1 else f"{self.masses} masses were"
        told = f"{masses} read at several visits: the last one before excision is analysed, readings left out: "
        lost = [
            f"{name}: {n} mass{'es' * (n > 1)} left out, read at other visits alone"
            for name, n in self.only_there.items()
        ]
        return [told + ", ".join(parts), *lost]


def in_order(visits: Mapping[str, date | None]) -> list[str] | None:
    """Codes of visits in order of time: by their dates, else by their numbers; None where neither gives an order.

    Parameters
    ----------
    visits
        Date of each visit, by its code. A code may itself be a date or end in a number, as in 2026-03-01, 2 or V2.
    """
    if len(visits) < 2:
        return list(visits)
    days = {code: day or day_of(code) for code, day in visits.items()}
    known = [day for day in days.values() if day is not None]
    numbers = _numbers(visits)
    if len(known) == len(visits):
        ordered = sorted(visits, key=lambda code: days[code] or date.min)
        return ordered if len(set(known)) == len(visits) else None
    return None if numbers is None else sorted(visits, key=lambda code: numbers[code])


def day_of(code: str) -> date | None:
    """The date that a visit's code is; None where it is none."""
    try:
        return date.fromisoformat(code) if len(code) == len("2026-03-01") else None
    except ValueError:
        return None


def _numbers(codes: Iterable[str]) -> dict[str, int] | None:
    """Number of each visit by the end of its code; None where they have none, or several stems."""
    found = {code: _NUMBERED.fullmatch(code) for code in codes}
    numbers = {code: int(one[2]) for code, one in found.items() if one is not None}
    stems = {one[1].casefold() for one in found.values() if one is not None}
    return numbers if len(numbers) == len(found) == len(set(numbers.values())) and len(stems) <= 1 else None


def at_excision(
    readings: Sequence[Reading], excised_on: Mapping[MassKey, date | None], *, fault: CellFault
) -> tuple[list[Reading], OtherVisits]:
    """The readings of each mass at its last visit on or before excision, and what that leaves out.

    Readings that name neither visit nor date stay. Without dates the visits are in order of their numbers, and the last
    one is taken to lie before excision.

    Parameters
    ----------
    readings
        In the order of the table's rows.
    excised_on
        Date of excision, by mass; None where it is not known.

    Raises
    ------
    BadDataError
        Naming the row: visits whose order is not known, an excision before every visit, a reading that does not say
        of which of several visits it is.
    """
    by_mass: dict[MassKey, list[Row]] = defaultdict(list)
    for row in enumerate(readings):
        by_mass[row[1].key].append(row)
    several = earlier = later = 0
    dropped: set[int] = set()
    only_there: Counter[str] = Counter()
    for key, rows in by_mass.items():
        visits, after = _of_mass(rows, excised_on.get(key), fault=fault)
        last = visits[-1] if visits else None
        left = {i for i, one in rows if (name := _visit(one)) is not None and name != last}
        several += len(visits) + len(after) > 1
        later += sum(_visit(readings[i]) in after for i in left)
        dropped |= left
        kept = {one.modality for i, one in rows if i not in left}
        only_there.update({one.modality for _, one in rows} - kept)
    earlier = len(dropped) - later
    analysed = [one for i, one in enumerate(readings) if i not in dropped]
    return analysed, OtherVisits(several, earlier, later, dict(sorted(only_there.items())))


def _visit(reading: Reading) -> str | None:
    """Code of a reading's visit, or else its date."""
    return reading.visit or (None if reading.day is None else reading.day.isoformat())


def _of_mass(rows: Sequence[Row], excised: date | None, *, fault: CellFault) -> tuple[list[str], set[str]]:
    """Visits of a mass up to its excision, in order, and those after it."""
    first = {name: i for i, one in reversed(rows) if (name := _visit(one)) is not None}
    days = {name: _latest(rows, name) for name in first}
    after = {name for name, day in days.items() if excised is not None and day is not None and day > excised}
    before = {name: day for name, day in days.items() if name not in after}
    if after and not before:
        row = min(first.values())
        what = f"of this mass and all its others are after excision on {excised}"
        raise fault(row, "date", what, way_out="correct the date here or of excision, or leave the readings out")
    if len(first) > 1:
        _check_said(rows, fault=fault)
    order = in_order(before)
    if order is None:
        names = " and ".join(sorted(before, key=lambda name: first[name]))
        what = f"{names} of one mass do not say which was first"
        way_out = "give each reading its date, or number the visits in order of time"
        raise fault(max(first[name] for name in before), "visit", what, way_out=way_out)
    _check_dates(order, before, first, fault=fault)
    return order, after


def _latest(rows: Sequence[Row], visit: str) -> date | None:
    """Latest date of a visit's readings; None where none has one."""
    days = [one.day for _, one in rows if _visit(one) == visit and one.day is not None]
    return max(days, default=day_of(visit))


def _check_said(rows: Sequence[Row], *, fault: CellFault) -> None:
    """Refuse, in a mass of several visits, readings that do not say of which they are beside others that do."""
    coded = any(one.visit for _, one in rows)
    timed = {one.modality for _, one in rows if _visit(one) is not None}
    for i, one in rows:
        if one.visit is None and ((coded and one.day is not None) or (one.day is None and one.modality in timed)):
            what = "is blank while other readings of the mass are of several visits"
            raise fault(i, "visit", what, way_out="give every reading of the mass its visit")


def _check_dates(
    order: Sequence[str], days: Mapping[str, date | None], first: Mapping[str, int], *, fault: CellFault
) -> None:
    """Refuse dates that contradict the visits' numbers."""
    numbers = _numbers(order) or {}
    dated = [name for name in order if days[name] is not None and name in numbers]
    for one, later in pairwise(sorted(dated, key=lambda name: numbers[name])):
        if (days[later] or date.max) < (days[one] or date.min):
            what = f"visit {later} is of {days[later]}, before visit {one} of {days[one]}"
            raise fault(first[later], "date", what, way_out="correct the date, or the visits' numbers")
