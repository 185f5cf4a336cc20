"""What a file calls the arrays of a scan, as TOML, and a template of it for a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from tactile_bayes.files.arrays_layout import KNOWN, LAYOUT, OPTIONAL, ArrayMap, Shape, in_words
from tactile_bayes.files.documents import dump_json, read_toml_record
from tactile_bayes.files.named_arrays import read_named

_HEADING: Final = """\
# Names of a scan's arrays in {path}, for `tactile-bayes import SRC --columns MAP.toml -o SCAN.mcap`.
# Complete it, and leave out what another file gives: --head-geometry, --array-calibration, --landmarks, --poses.

# unit = "kPa"        # of frames that are pressures (or Pa, psi, mmHg, N/cm2): they need no gain and no offset
# time_unit = "ms"    # of the frames' times, where it is not s (or us, min)
# length_unit = "cm"  # of the places, where it is not mm (or m, inch)
"""


def read_array_map(path: Path) -> ArrayMap:
    """Read what a file calls its arrays; for the errors see `files.documents.read_record`."""
    return read_toml_record(path, ArrayMap, way_out="`tactile-bayes import SRC --template` prints one")


def array_template(path: Path | None) -> str:
    """TOML for `read_array_map` to fill in: of a file, with its arrays and those that their shapes tell."""
    shapes = {} if path is None else {name: one.shape for name, one in read_named(path, list).items()}
    return "\n".join([_HEADING.format(path=path or "a file"), *_held(shapes), *_arrays(shapes), *_values()]) + "\n"


def _held(shapes: Mapping[str, Shape]) -> Iterator[str]:
    if shapes:
        yield "# The file has:"
        yield from (f"#   {name}: {' x '.join(map(str, shape)) or 'one value'}" for name, shape in shapes.items())
        yield ""


def _arrays(shapes: Mapping[str, Shape]) -> Iterator[str]:
    yield "[arrays]"
    guessed = _guessed(shapes)
    for name, layout in LAYOUT.items():
        told = f"{in_words(layout.shape)}: {layout.meaning}"
        yield _line(name, guessed, shapes, f"may be left out; {told}" if name in OPTIONAL else told)
    yield _line("pose_matrix", guessed, shapes, "m, 4, 4: in place of position_mm and quaternion_wxyz")


def _line(name: str, guessed: Mapping[str, str], shapes: Mapping[str, Shape], told: str) -> str:
    if name in shapes:
        return f"# {name} is called so  # {told}"
    if name in guessed:
        return f"{name} = {_quoted(guessed[name])}  # guessed by its shape; {told}"
    return f'# {name} = ""  # {told}'


def _values() -> Iterator[str]:
    yield from ("", "[values]", "# pitch_mm = 1.5  # numbers that no file has")


def _guessed(shapes: Mapping[str, Shape]) -> dict[str, str]:
    """Arrays that are the only ones of their shape, where the file has none of the layout's name."""
    free = {name: tuple(one for one in shape if one != 1) for name, shape in shapes.items() if name not in KNOWN}

    def of(fits: Callable[[Shape], bool]) -> list[str]:
        return [name for name, shape in free.items() if fits(shape)]

    found = {
        "array_from_tracker": of(lambda s: s == (4, 4)),
        "head_surface_mm": of(lambda s: len(s) == 3 and s[-1] == 3),
        "pose_matrix": of(lambda s: len(s) == 3 and (4, 4) in (s[:2], s[1:])),
        "counts": of(lambda s: len(s) == 3 and s[-1] != 3 and (4, 4) not in (s[:2], s[1:])),
        "position_mm": of(lambda s: len(s) == 2 and s[1] == 3),
        "quaternion_wxyz": of(lambda s: len(s) == 2 and s[1] == 4 and s[0] != 4),
    }
    timed = {"frame_time_s": ("counts",), "pose_time_s": ("position_mm", "pose_matrix")}
    for here, places in timed.items():
        ends = {end for name in places if len(found[name]) == 1 for end in _ends(free[found[name][0]])}
        found[here] = of(lambda s, ends=ends: len(s) == 1 and s[0] in ends)  # type: ignore[misc]
    return {here: names[0] for here, names in found.items() if here not in shapes and len(names) == 1}


def _ends(shape: Shape) -> set[Any]:
    """The longer of an array's first and last axis, which may be that of time."""
    return {max(shape[0], shape[-1], key=int)}


def _quoted(name: str) -> str:
    return dump_json(name).strip()
