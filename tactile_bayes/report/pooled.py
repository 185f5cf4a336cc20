"""Reports of one size from several maps, as plain data and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tactile_bayes.files.provenance import Provenance, repeated_scans, scans_of
from tactile_bayes.inference.summary import nine_digits
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.narrowing import MORE, MOST_LINES, joined, width_lines
from tactile_bayes.report.population_text import fat_text, unknowns_text
from tactile_bayes.report.quantities import ANOTHER_EXAM, another_exam
from tactile_bayes.report.site_text import site_words
from tactile_bayes.report.size_text import (
    SIZE_DECIMALS,
    decimals,
    ends_text,
    exams_label,
    range_cautions,
    shape_text,
    site_interval_text,
    table_head,
    table_row,
)
from tactile_bayes.report.supposed_text import supposed_document, supposed_line, supposed_lines
from tactile_bayes.report.touching import touching_sentences
from tactile_bayes.size import omissions
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.pooling import PooledEstimate
from tactile_bayes.size.posterior import EXTREMES, SizePosterior
from tactile_bayes.size.repeatability import Repeatability

SCHEMA = "tactile-bayes/pooled/1"
MOST_NAMED = 4


def pooled_document(
    pooled: PooledEstimate,
    names: Sequence[str],
    documents: Sequence[Mapping[str, Any]],
    calibration: BodyCalibration,
    *,
    probability: float,
    provenance: Provenance,
    repeatability: Repeatability | None = None,
    apart: Mapping[int, str] | None = None,
    one_place: bool | None = None,
) -> dict[str, Any]:
    """JSON object of a mass, see data_schema/pooled.schema.json.

    Parameters
    ----------
    names, documents
        Of the maps, with what `estimate` says of each.
    repeatability
        The site's, where the size is by it.
    apart
        What is to be said of maps whose mass lies elsewhere than the others', by their place in the list.
    one_place
        Whether the masses of all maps lie at one place in the patient; None where that cannot be told.
    """
    size, used = pooled.size, pooled.calibration or calibration
    sizes: dict[str, Any] = dict.fromkeys(EXTREMES)
    largest = None if size is None else size.summarise("max_size_mm", probability=probability)
    if size is not None:
        sizes = {name: size.summarise(name, probability=probability).as_dict() for name in EXTREMES}
    return {
        "schema": SCHEMA,
        "status": pooled.status,
        "reason": pooled.reason,
        **sizes,
        ANOTHER_EXAM: _another_exam(size, probability),
        "supposing": supposed_document(size, largest),
        "maps": _maps(names, documents, pooled, apart or {}),
        "one_place": one_place,
        "variance_share": None if size is None else {k: nine_digits(v) for k, v in size.variance_share.items()},
        "figures": {} if size is None else {name: nine_digits(value) for name, value in size.figures.items()},
        "left_out": _omitted(used, documents),
        "by_place_used": used.knows_places,
        "fat_mm": None if used.fat_mm is None else nine_digits(used.fat_mm),
        "fat_apart_mm": None if pooled.fat_apart_mm is None else [nine_digits(depth) for depth in pooled.fat_apart_mm],
        "unknowns": {name: nine_digits(share) for name, share in used.unknowns.items()},
        "site": None if used.site is None else site_words(used.site),
        **({} if repeatability is None else {"repeatability": repeatability.words()}),
        "outside_calibration": list(pooled.outside),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def _omitted(used: BodyCalibration, documents: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the pooled size does not contain, in words."""
    head = omissions.head(used.recipe.head)
    unknown = any(head in document["left_out"] for document in documents)
    return [*([head] if unknown else []), *used.omissions()]


def _another_exam(size: SizePosterior | None, probability: float) -> dict[str, Any] | None:
    another = None if size is None else size.another_exam
    if another is None:
        return None
    names = {f"{ANOTHER_EXAM}.{name}": another.summarise(name, probability=probability) for name in EXTREMES}
    return another_exam(size, names)


def _map(index: int, name: str, document: Mapping[str, Any], pooled: PooledEstimate) -> dict[str, Any]:
    return {
        "map": name,
        "other_rises": list(document["other_rises"]),
        "touching": list(document.get("touching", [])),
        "mass": _reported(document),
        "status": document["status"],
        "reason": document["reason"],
        "detected_probability": document["detected_probability"],
        "log_size": nine_digits(pooled.centres[index]) if index in pooled.centres else None,
        "outlying": index in pooled.outlying,
        "broken_assumptions": [
            *filter(None, [document.get("side_caution")]),
            *document["diagnostics"].get("broken_assumptions", []),
        ],
    }


def _reported(document: Mapping[str, Any]) -> list[int]:
    """Number of the mass that was sized and how many its map has; empty where it is the only one."""
    masses = document.get("masses", [])
    numbers = [one["number"] for one in masses if one["reported"]]
    return [*numbers, len(masses)] if len(masses) > 1 and numbers else []


def _maps(
    names: Sequence[str], documents: Sequence[Mapping[str, Any]], pooled: PooledEstimate, apart: Mapping[int, str]
) -> list[dict[str, Any]]:
    """The maps; one of another mass, or of a scan that an earlier map is of, says so among its broken assumptions."""
    maps = [_map(i, name, documents[i], pooled) for i, name in enumerate(names)]
    for index, words in apart.items():
        maps[index]["broken_assumptions"].append(words)
    for index, earlier in repeated_scans([scans_of(one["provenance"]) for one in documents]).items():
        words = f"a map of the same scan as {maps[earlier]['map']} is no repeat: the interval is too narrow"
        maps[index]["broken_assumptions"].append(words)
    return maps


def pooled_summary(document: Mapping[str, Any]) -> str:
    """Report of a mass in at most 12 lines; `pooled_text` gives the rest."""
    outside = document["outside_calibration"]
    lines = [*_bodies(document), *joined(outside, most=2, lead="CAUTION: outside the calibration's range: ")]
    lines += joined(_broken(document["maps"]), most=1, lead="CAUTION: ") + _maps_lines(document["maps"])
    lines += joined([line.rstrip(".") for line in _rises(document)], most=1, lead="")
    if document["status"] == "no_estimate":
        lines.append(f"No estimate: {document['reason']}.")
    else:
        largest, spread = document["max_size_mm"], document["figures"]["between_map_sd"]
        lines += _table(document) + width_lines(document["variance_share"])
        ends = f"interval ends to {largest['mc_error'] / largest['sd']:.3f} SD; " if largest["sd"] > 0 else ""
        by = f"sizes by {document['site']}; " if document["site"] else ""
        site = f"; {document['repeatability']}" if "repeatability" in document else ""
        form = "; irregular outline, with a wider interval" if document["figures"].get("irregular_outline") else ""
        lines.append(f"Quality: {by}{ends}the maps of this mass differ by {100 * spread:.0f} %{site}{form}.")
        if len(lines) < MOST_LINES - 2:
            places = decimals(_worst(document)["mc_error"], most=SIZE_DECIMALS)
            lines += supposed_line(document["supposing"], largest["median"], places=places)
    return "\n".join([*lines, MORE, RESEARCH_USE]) + "\n"


def _maps_lines(maps: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sizes of the maps in one line, doubtful maps by name, other rises."""
    found = [one for one in maps if one["log_size"] is not None]
    sizes = ", ".join(f"{np.exp(one['log_size']):.1f}" for one in found[:MOST_NAMED])
    more = f" and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
    lines = [f"A lump was found on {len(found)} of {len(maps)} maps, alone sized at {sizes}{more} mm."] if found else []
    apart = [one["map"] for one in maps if one["outlying"]]
    lines += joined(apart, most=2, lead="Apart from the others, look at these maps: ")
    return lines + joined(_touching(maps), most=1, lead="To check: ")


def _touching(maps: Sequence[Mapping[str, Any]]) -> list[str]:
    """Masses that may be one lump, with the map's name; files of earlier versions name none."""
    return [f"{one['map']}: {text}" for one in maps for text in touching_sentences(one.get("touching", []))]


def _broken(maps: Sequence[Mapping[str, Any]]) -> list[str]:
    """Broken assumptions of the maps in which a lump was found, with the map's name."""
    found = [one for one in maps if one["log_size"] is not None]
    return [f"{one['map']}: {text}" for one in found for text in one["broken_assumptions"]]


def pooled_text(document: Mapping[str, Any]) -> str:
    """Full report of a mass."""
    lines = [*_bodies(document), *range_cautions(document["outside_calibration"])]
    lines += [f"CAUTION: {text}." for text in _broken(document["maps"])]
    lines += [_map_line(one) for one in document["maps"]]
    lines += [f"To check: {text}." for text in _touching(document["maps"])]
    lines += _rises(document)
    if document["status"] == "no_estimate":
        return "\n".join([*lines, f"No estimate: {document['reason']}.", RESEARCH_USE]) + "\n"
    worst, figures = _worst(document), document["figures"]
    lines += ["", *_table(document)]
    lines += ["", *width_lines(document["variance_share"])]
    places = decimals(worst["mc_error"], most=SIZE_DECIMALS)
    lines += supposed_lines(document["supposing"], document["max_size_mm"]["median"], places=places)
    lines.append(f"Spread between the maps of this mass: {100 * figures['between_map_sd']:.0f} %.")
    if "repeatability" in document:
        lines.append(site_interval_text(document["repeatability"]))
    lines.append(shape_text(figures))
    lines.append(f"Monte-Carlo error of the interval ends: {ends_text('sizes', worst['mc_error'], worst['sd'])}.")
    lines.append(_unknowns(document))
    if document["site"]:
        lines.append(f"Sizes by {document['site']}.")
    if document["left_out"]:
        lines.append(f"Left out: {'; '.join(document['left_out'])}.")
    if document["reason"]:
        lines.append(f"{document['reason']}.")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _worst(document: Mapping[str, Any]) -> Mapping[str, float]:
    """Summary of the size with the larger Monte-Carlo error."""
    return max((document[name] for name in EXTREMES), key=lambda q: q["mc_error"])


def _table(document: Mapping[str, Any]) -> list[str]:
    """Table of both sizes with their intervals."""
    probability = document["max_size_mm"]["probability"]
    places = decimals(_worst(document)["mc_error"], most=SIZE_DECIMALS)
    lines = [table_head(probability)]
    for name, label in zip(EXTREMES, ("largest size", "smallest size"), strict=True):
        q = document[name]
        lines.append(_row(label, q, places))
    another = document[ANOTHER_EXAM]
    if another is not None:
        lines.insert(2, _row(exams_label(another["between_map_sd"]), another["max_size_mm"], places))
    return lines


def _row(label: str, q: Mapping[str, float], places: int) -> str:
    return table_row(label, q["median"], (q["low"], q["high"]), unit="mm", places=places)


def _bodies(document: Mapping[str, Any]) -> list[str]:
    """Caution where the maps differ too much to be of one body; else empty."""
    if not document["fat_apart_mm"]:
        return []
    least, largest = document["fat_apart_mm"]
    depths = f"the fat under the head is {least:.1f} mm deep on one map and {largest:.1f} mm on another"
    used = f" All are sized at {document['fat_mm']:.1f} mm." if document["fat_mm"] else ""
    return [f"CAUTION: {depths}: are they of one mass?{used}"]


def _map_line(one: Mapping[str, Any]) -> str:
    if one["log_size"] is None:
        return f"{one['map']}: no estimate ({one['reason']})"
    apart = "  lies apart from the others: look at this map" if one["outlying"] else ""
    mass = "  (mass {} of {} on this map)".format(*one["mass"]) if one.get("mass") else ""
    return f"{one['map']}: {np.exp(one['log_size']):.1f} mm{mass}{apart}"


def _rises(document: Mapping[str, Any]) -> list[str]:
    """Other rises of the maps, where places do not tell that all were sized at one mass."""
    if document.get("one_place"):
        return []
    return [_rise_line(one["map"], rise) for one in document["maps"] for rise in one["other_rises"]]


def _rise_line(name: str, rise: Mapping[str, float]) -> str:
    where = f"({rise['x_mm']:.1f}, {rise['y_mm']:.1f}) mm"
    chance = f"probability of a lump {rise['probability']:.3f}"
    return f"{name}: another rise stands at {where} ({chance}); check that every map was sized at the same mass."


def _unknowns(document: Mapping[str, Any]) -> str:
    text = fat_text(document["fat_mm"], by_place=document["by_place_used"]) + unknowns_text(document["unknowns"])
    return text[0].upper() + text[1:] + "."
