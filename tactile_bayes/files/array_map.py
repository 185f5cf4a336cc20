"""What a file calls the arrays of a scan, as TOML, and a template of it for a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
_VALUES: Final = """
[values]
# pitch_mm = 1.5  # numbers that no file has
"""


def read_array_map(path: Path) -> ArrayMap:
    """Read what a file calls its arrays; for the errors see `files.documents.read_record`."""
    return read_toml_record(path, ArrayMap, way_out="`tactile-bayes import SRC --template` prints one")


def array_template(path: Path | None) -> str:
    """TOML for `read_array_map` to fill in: of a file, with its arrays and those that their shapes tell."""
    shapes = {} if path is None else {name: one.shape for name, one in read_named(path, list).items()}
    held = [f"#   {name}: {' x '.join(map(str, shape)) or 'one value'}" for name, shape in shapes.items()]
    told = ["# The file has:", *held, ""] if held else []
    return "\n".join([_HEADING.format(path=path or "a file"), *told, *_arrays(shapes), _VALUES])


_PLAIN: Final[Mapping[str, tuple[str, ...]]] = {
    "counts": ("pressure", "pressures", "readings"),
    "position_mm": ("position", "positions", "pos", "xyz", "translation"),
    "quaternion_wxyz": ("quaternion", "quaternions", "quat", "quats"),
    "pose_matrix": ("transforms", "matrices", "pose_matrices"),
    "frame_time_s": ("frame_time", "frame_times", "time", "times", "t", "timestamps"),
    "pose_time_s": ("pose_time", "pose_times", "tracker_time", "tracker_times", "time", "times", "t", "timestamps"),
    "array_from_tracker": ("scanhead_from_tracker", "head_from_tracker", "lever_arm"),
    "head_surface_mm": ("surface_mm", "head_surface"),
    "pitch_mm": ("pitch",),
}
"""Plain words for arrays; times are told apart by the group that they stand in."""
_BESIDE: Final = {"frame_time_s": ("counts", "frames"), "pose_time_s": ("position_mm", "pose_matrix")}


def plain_names(
    names: Sequence[str], known: Mapping[str, str], values: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """Names in a file that are plain words for arrays which are neither `known` in it nor `values` given elsewhere, by
    the names here.
    """
    found: dict[str, str] = {}
    for here, words in _PLAIN.items():
        same = {here, "frames"} if here == "counts" else {here}
        if same & {*known, *(values or {})}:
            continue
        taken = {*known.values(), *found.values()}
        alike = [name for name in names if name.rpartition(".")[2].lower() in words and name not in taken]
        alike = [name for name in alike if name.rpartition(".")[2] in words] or alike  # t, where there is a T too
        if here in _BESIDE:
            both = {**known, **found}
            group = next((both[one].rpartition(".")[0] for one in _BESIDE[here] if one in both), "")
            alike = [name for name in alike if name.rpartition(".")[0] == group] or alike
            if here == "pose_time_s" and not group:  # beside the frames, `time` is theirs
                alike = [name for name in alike if name.lower() not in _PLAIN["frame_time_s"]]
        if len(alike) == 1:
            found[here] = alike[0]
    return found


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
    if name == "counts" and "frames" in shapes:
        return f"# counts are called frames  # {told}"
    if name in guessed:
        return f"{name} = {dump_json(guessed[name]).strip()}  # guessed; {told}"
    return f'# {name} = ""  # {told}'


def _guessed(shapes: Mapping[str, Shape]) -> dict[str, str]:
    """Arrays that are the only ones of their shape, or called by a plain word, where none has the layout's name."""
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
    for here, places in _BESIDE.items():
        only = [free[found[name][0]] for name in places if len(found.get(name, ())) == 1]
        only += [shapes[name] for name in places if name in shapes]
        ends = {max(shape[0], shape[-1], key=int) for shape in only}  # either may be that of time
        found[here] = of(lambda s, ends=ends: len(s) == 1 and s[0] in ends)  # type: ignore[misc]
    by_shape = {here: names[0] for here, names in found.items() if here not in shapes and len(names) == 1}
    return by_shape | plain_names(list(shapes), {name: name for name in KNOWN if name in shapes})
