"""Records behave as the standard library's frozen data classes do, whose place they take."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import pytest

from tactile_bayes import records


@records.dataclass(frozen=True, slots=True)
class Place:
    """A record that is compared by its values."""

    x: float
    y: float = 0.0


@dataclasses.dataclass(frozen=True, slots=True)
class Theirs:
    x: float
    y: float = 0.0


@records.dataclass(frozen=True, slots=True, eq=False)
class Held:
    """A record that is itself only."""

    values: list[float] = dataclasses.field(default_factory=list)


def test_values_decide_equality_and_hash() -> None:
    assert Place(1.0) == Place(1.0, 0.0) != Place(2.0)
    assert len({Place(1.0), Place(1.0, 0.0), Place(2.0)}) == 2
    assert Place(1.0) != Theirs(1.0)
    one = Held()
    assert one == one != Held()


def test_they_print_as_the_library_s() -> None:
    assert repr(Place(1.0)).replace("Place", "Theirs") == repr(Theirs(1.0))


@pytest.mark.parametrize("kind", [Place, Theirs])
def test_nothing_is_set_or_deleted_later(kind: type) -> None:
    place = kind(1.0)
    with pytest.raises(dataclasses.FrozenInstanceError, match="cannot assign to field 'x'"):
        place.x = 2.0
    with pytest.raises(dataclasses.FrozenInstanceError, match="cannot delete field 'x'"):
        del place.x
    assert not hasattr(place, "__dict__")


def test_the_library_s_helpers_take_them() -> None:
    place = Place(1.0, 2.0)
    assert dataclasses.replace(place, y=3.0) == Place(1.0, 3.0)
    assert dataclasses.asdict(place) == {"x": 1.0, "y": 2.0}
    assert copy.deepcopy(place) == copy.copy(place) == pickle.loads(pickle.dumps(place)) == place
