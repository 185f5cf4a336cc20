"""Records are read, refused in plain words, written and described from one declaration."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import fastjsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from record_schema import schema_of

from tactile_bayes.declarations import (
    Meta,
    Record,
    as_dict,
    field,
    from_plain,
    names_of,
    replace,
    set_fields,
    to_plain,
)
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import read_record, read_toml_record
from tactile_bayes.geometry import Matrix, Vector

Name = Annotated[
    str, Meta(pattern="^[a-z]{1,8}$", extra={"words": "up to 8 small letters"}, description="What it is called.")
]


class Ball(Record):
    """A ball."""

    d_mm: Annotated[float, Meta(gt=0, le=80, description="Diameter, mm.")]


class Rod(Record):
    """A rod."""

    length_mm: Annotated[float, Meta(ge=1, description="Length, mm.")]
    ends: tuple[float, float] = (0.0, 1.0)


class Scene(Record, eq=False):
    """Lumps under a head.

    Not part of the title.
    """

    schema: Literal["tactile-bayes/test-scene/1"]
    name: Name
    side: Literal["left", "right"]
    weights: Vector
    rods: list[Rod] = field(default_factory=list)
    first: Ball | None = None
    rows: Annotated[int, Meta(ge=1, le=99)] | None = None
    covariance: Matrix | None = None
    fit: dict[Name, float] = field(default_factory=dict)
    dates: Annotated[list[str], Meta(min_length=1)] | None = None
    kept: bool = True
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.covariance is not None and len(self.covariance) != len(self.weights):
            raise BadDataError(f"has {len(self.covariance)} rows of covariance", way_out="give one for each weight")


GOOD = {"schema": "tactile-bayes/test-scene/1", "name": "one", "side": "left", "weights": [1, 2.5]}
WHOLE = GOOD | {
    "rods": [{"length_mm": 3, "ends": [1, 2]}],
    "first": {"d_mm": 1.0},
    "rows": 3,
    "covariance": [[1, 0.5], [0.5, 1]],
    "fit": {"r": 0.5},
    "dates": ["2026-01-31"],
    "kept": False,
    "extra": {"deep": {"er": [None, "text"]}},
}
REFUSED = [
    ([1], "the document is [1]; give a table of keys"),
    ({"name": "one"}, "the document has no schema; add it"),
    (GOOD | {"weight": 3}, "weight is not known; did you mean weights?"),
    (GOOD | {"a.b": 3}, "'a.b' is not known; known are schema, name,"),
    (GOOD | {"name": "No!"}, "name is 'No!'; give up to 8 small letters"),
    (GOOD | {"name": 3}, "name is 3; give up to 8 small letters"),
    (GOOD | {"side": "lift"}, "side is 'lift'; did you mean left? Give one of left, right"),
    (GOOD | {"side": None}, "side is None; give one of left, right"),
    (GOOD | {"weights": [1, "2"]}, "weights[1] is '2'; give a number"),
    (GOOD | {"weights": [1, True]}, "weights[1] is True; give a number"),
    (GOOD | {"covariance": [[1, 2], [3, None]]}, "covariance[1][1] is None; give a number"),
    (GOOD | {"weights": 1.0}, "weights is 1.0; give a list of numbers"),
    (GOOD | {"covariance": [[1], [1, 2]]}, "covariance has rows of different lengths; give numbers"),
    (GOOD | {"covariance": [[1]]}, "has 1 rows of covariance; give one for each weight"),
    (GOOD | {"rows": 0}, "rows is 0; give a whole number from 1 to 99"),
    (GOOD | {"rows": 1.5}, "rows is 1.5; give a whole number from 1 to 99"),
    (GOOD | {"rows": True}, "rows is True; give a whole number from 1 to 99"),
    (GOOD | {"first": {"d_mm": 0}}, "first.d_mm is 0; give a number above 0 up to 80"),
    (GOOD | {"first": {}}, "first has no d_mm; add it"),
    (GOOD | {"rods": [{"length_mm": 1}, {"length_mm": 0}]}, "rods[1].length_mm is 0; give"),
    (GOOD | {"rods": [{"length_mm": 1, "ends": [1]}]}, "rods[0].ends is [1]; give a list of 2"),
    (GOOD | {"rods": [{"length_mm": 1, "ends": [1, "b"]}]}, "rods[0].ends[1] is 'b'; give a number"),
    (GOOD | {"fit": {"r": "x"}}, "fit.r is 'x'; give a number"),
    (GOOD | {"fit": {"R 2": 1}}, "fit.key 'R 2' is 'R 2'; give up to 8 small letters"),
    (GOOD | {"dates": []}, "dates is []; give a list of 1 or more"),
    (GOOD | {"kept": "yes"}, "kept is 'yes'; give true or false"),
    (GOOD | {"schema": "tactile-bayes/test-scene/2"}, "give 'tactile-bayes/test-scene/1'"),
]


def test_a_whole_document_comes_back_as_it_was():
    record = from_plain(Scene, WHOLE)
    assert record.covariance is not None
    assert record.covariance.dtype == np.float64
    assert record.weights.shape == (2,)
    assert isinstance(record.rods[0], Rod)
    assert to_plain(record) == WHOLE


def test_a_whole_number_written_as_a_float_is_one():
    record = from_plain(Scene, GOOD | {"rows": 7.0, "weights": [2.0]})
    assert (record.rows, type(record.rows), record.weights.dtype) == (7, int, np.float64)


def test_floats_are_written_with_nine_digits_and_whole_numbers_stay():
    record = from_plain(Scene, GOOD | {"rows": 7, "weights": [1 / 3]})
    assert to_plain(record)["weights"] == [0.333333333]
    assert to_plain(record, digits=3)["weights"] == [0.333]
    assert type(to_plain(record)["rows"]) is int


@pytest.mark.parametrize(("document", "words"), REFUSED, ids=[words for _, words in REFUSED])
def test_what_is_refused_is_told_in_words(document, words):
    with pytest.raises(BadDataError) as error:
        from_plain(Scene, document)
    assert words in str(error.value)
    assert not any(jargon in str(error.value) for jargon in ("$", "regex", "propert", "`", "object", "array"))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*WHOLE, "x"]), inner),
    max_leaves=9,
)


@given(st.sampled_from(sorted(WHOLE)), JSON)
def test_whatever_stands_in_a_field_is_taken_or_refused_in_one_line(name, value):
    found: Any = None
    try:
        taken = from_plain(Scene, WHOLE | {name: value})
    except BadDataError as error:
        found = error
    if found is None:
        assert from_plain(Scene, to_plain(taken, digits=17)).name == taken.name
    else:
        assert "\n" not in str(found)
        assert found.way_out


@pytest.mark.parametrize("document", [GOOD, WHOLE])
def test_the_schema_takes_what_the_reader_takes(document):
    fastjsonschema.validate(schema_of(Scene), copy.deepcopy(document))


@pytest.mark.parametrize(
    "document", [document for document, words in REFUSED if "rows" not in words and "covariance" not in words]
)
def test_the_schema_refuses_what_the_reader_refuses(document):
    with pytest.raises(fastjsonschema.JsonSchemaException):
        fastjsonschema.validate(schema_of(Scene), copy.deepcopy(document))


def test_a_schema_says_ranges_meanings_and_defaults_without_names_of_classes():
    schema = schema_of(Scene)
    assert schema["title"] == "Lumps under a head"
    assert schema["required"] == ["schema", "name", "side", "weights"]
    assert schema["properties"]["schema"] == {"const": "tactile-bayes/test-scene/1"}
    assert schema["properties"]["rods"]["items"]["properties"]["length_mm"] == {
        "description": "Length, mm.",
        "type": "number",
        "minimum": 1,
    }
    assert "Rod" not in json.dumps(schema)
    assert "$ref" not in json.dumps(schema)


def test_a_record_is_a_value_that_nothing_changes():
    ball = Ball(3.0)
    assert ball == Ball(3.0) != Ball(4.0)
    assert replace(ball, d_mm=4.0) == Ball(4.0)
    assert pickle.loads(pickle.dumps(ball)) == copy.deepcopy(ball) == ball
    with pytest.raises(AttributeError):
        ball.d_mm = 4.0  # type: ignore[misc]
    with pytest.raises(AttributeError):
        del ball.d_mm
    assert not hasattr(ball, "__dict__")


def test_values_decide_equality_and_hash_but_for_records_of_arrays():
    assert len({Ball(1.0), Ball(1.0), Ball(2.0)}) == 2
    assert Ball(1.0) != Rod(1.0)
    one, other = from_plain(Scene, GOOD), from_plain(Scene, GOOD)
    assert one == one != other
    assert len({one, other}) == 2


class Settled(Record, eq=False):
    """A record that makes an array of what it is given."""

    values: Vector
    balls: tuple[Ball, ...] = ()
    where: Mapping[str, Ball] = field(default_factory=dict)

    def __post_init__(self) -> None:
        set_fields(self, values=np.asarray(self.values, dtype=float))


def test_a_record_settles_its_fields_when_it_is_made_and_when_it_is_changed():
    assert Settled([1, 2]).values.dtype == np.float64  # type: ignore[arg-type]
    assert replace(Settled([1]), values=[3]).values.shape == (1,)  # type: ignore[arg-type]


@dataclasses.dataclass
class Mutable:
    """A data class of the standard library, for what changes."""

    ball: Ball


def test_the_values_of_a_record_by_name_are_those_of_its_parts_too():
    assert names_of(Ball) == names_of(Ball(1.0)) == ("d_mm",)
    values = np.ones(2)
    found = as_dict(Settled(values, (Ball(1.0),), {"a": Ball(2.0)}))
    assert found.pop("values") is values
    assert found == {"balls": ({"d_mm": 1.0},), "where": {"a": {"d_mm": 2.0}}}
    assert names_of(Mutable) == ("ball",)
    assert as_dict(Mutable(Ball(2.0))) == {"ball": {"d_mm": 2.0}}


def test_a_record_prints_no_draws():
    shown = repr(from_plain(Scene, WHOLE | {"weights": [0.0] * 1000, "covariance": None}))
    assert "weights=<array 1000>" in shown
    assert "side='left'" in shown


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"schema": "tactile-bayes/plan/1"}', "is a trial plan (JSON), not a test scene (JSON)"),
        ('{"name": "one", "name": "two"}', "holds the key 'name' twice"),
        ('{"name": "\\u0000"}', "U+0000"),
        (f'{{"rows": {"9" * 400}}}', "a whole number of 400 digits"),
        ('{"fit": ' * 70 + "1" + "}" * 70, "nested more than 64 levels"),
        ('{"kept": NaN}', "nan"),
    ],
)
def test_a_file_is_guarded_before_it_is_read(tmp_path, text, words):
    path = tmp_path / "scene.json"
    path.write_text(text)
    with pytest.raises(BadDataError) as error:
        read_record(path, Scene)
    assert words in str(error.value)
    assert str(path) in str(error.value)


def test_a_toml_file_is_read_as_one_of_json(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('schema = "tactile-bayes/test-scene/1"\nname = "one"\nside = "left"\nweights = [1, 2.5]\n')
    assert to_plain(read_toml_record(path, Scene, way_out="see the schema")) == to_plain(from_plain(Scene, GOOD))


FIRST_USE = """
import sys, threading, types
from tactile_bayes.declarations import from_plain
SOURCE = '''
from __future__ import annotations
from typing import Annotated, Literal
from tactile_bayes.declarations import Meta, Record
class Part(Record):
    size: Annotated[float, Meta(ge=0)] | None = None
    word: Literal["x", "y"] | None = None
class Whole(Record):
    part: Part
    parts: tuple[Part, ...] = ()
    named: Annotated[dict[str, Part], Meta(description="x")] | None = None
'''
sys.setswitchinterval(1e-6)
made = []
for number in range(20):
    module = sys.modules[f"m{number}"] = types.ModuleType(f"m{number}")
    exec(SOURCE, module.__dict__)
    start = threading.Barrier(6)
    def use():
        start.wait()
        made.append(from_plain(module.Whole, {"part": {"size": 1.0}, "named": {"a": {"word": "x"}}}))
    threads = [threading.Thread(target=use) for _ in range(6)]
    [one.start() for one in threads], [one.join() for one in threads]
print(len(made))
"""


def test_threads_may_use_a_record_type_first_at_once(run_python: Any) -> None:
    """The process ended with a segmentation fault: four threads that estimated at once, in a fresh notebook."""
    done = run_python("-c", FIRST_USE)
    assert (done.returncode, done.stdout) == (0, "120\n"), done.stderr[-300:]
