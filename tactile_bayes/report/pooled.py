"""Reports of one size from several maps, as plain data and as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tactile_bayes.files.provenance import Provenance, repeated_scans, scans_of
from tactile_bayes.findings import Finding, by_weight, finding_lines, finding_summary, findings_in, verdict
from tactile_bayes.inference.draws import nine_digits
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.calibration import fat_text, site_words, unknowns_text
from tactile_bayes.report.estimate_document import supposed_document, supposed_line, supposed_lines
from tactile_bayes.report.estimate_text import (
    MORE,
    MOST_LINES,
    SIZE_DECIMALS,
    decimals,
    ends_text,
    exams_label,
    shape_text,
    site_interval_text,
    table_head,
    table_row,
    width_lines,
)
from tactile_bayes.report.quantities import ANOTHER_EXAM, another_exam, leading
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import EXTREMES, SizePosterior
from tactile_bayes.size.fat import LEAST_PROBABILITY
from tactile_bayes.size.pooling import DISAGREE, PooledEstimate, Repeatability
from tactile_bayes.size.terms import unknown_head

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
    findings = by_weight(_findings(pooled, documents, apart or {}, one_place=one_place))
    return {
        "schema": SCHEMA,
        "status": pooled.status,
        "verdict": verdict(findings, answered=size is not None),
        "findings": [one.as_dict() for one in findings],
        "reason": pooled.reason,
        **sizes,
        ANOTHER_EXAM: _another_exam(size, probability),
        "supposing": supposed_document(size, largest),
        "maps": [_map(i, name, documents[i], pooled) for i, name in enumerate(names)],
        "one_size_probability": None if pooled.one_size is None else nine_digits(pooled.one_size),
        "one_place_probability": None if pooled.one_place is None else nine_digits(pooled.one_place),
        "variance_share": None if size is None else {k: nine_digits(v) for k, v in size.variance_share.items()},
        "figures": {} if size is None else {name: nine_digits(value) for name, value in size.figures.items()},
        "left_out": _omitted(used, documents),
        "fat_mm": None if used.fat_mm is None else nine_digits(used.fat_mm),
        "unknowns": {name: nine_digits(share) for name, share in used.unknowns.items()},
        "site": None if used.site is None else site_words(used.site),
        **({} if repeatability is None else {"repeatability": repeatability.words()}),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def _omitted(used: BodyCalibration, documents: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the pooled size does not contain, in words."""
    head = unknown_head(used.recipe.head)
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
        "mass": _reported(document),
        "status": document["status"],
        "reason": document["reason"],
        "detected_probability": document["detected_probability"],
        "max_size_mm": _alone(document["max_size_mm"]),
        "outlying": index in pooled.outlying,
    }


def _alone(size: Mapping[str, Any] | None) -> dict[str, float] | None:
    """The largest size by one map, as its own estimate has it."""
    return None if size is None else {name: size[name] for name in ("median", "low", "high", "probability")}


def _reported(document: Mapping[str, Any]) -> list[int]:
    """Number of the mass that was sized and how many its map has; empty where it is the only one."""
    masses = document.get("masses", [])
    numbers = [one["number"] for one in masses if one["reported"]]
    return [*numbers, len(masses)] if len(masses) > 1 and numbers else []


def _findings(
    pooled: PooledEstimate,
    documents: Sequence[Mapping[str, Any]],
    apart: Mapping[int, str],
    *,
    one_place: bool | None,
) -> Iterator[Finding]:
    """What speaks against the size: of the maps in which a lump was found, and of the maps together."""
    if pooled.status == DISAGREE:
        yield disagreement(pooled.reason, *_chances(pooled))
    sized = [i for i, document in enumerate(documents) if document["status"] == "estimate"]
    for index in sized if pooled.status == DISAGREE else sorted(pooled.centres):
        for one in findings_in(documents[index]["findings"]):
            if one.kind != "outside_calibration":  # of the size alone
                yield one.at(_number(index))
    for index, words in apart.items():
        yield Finding("another_mass", words, about=_number(index))
    for index, earlier in repeated_scans([scans_of(one["provenance"]) for one in documents]).items():
        words = f"a map of the same scan as {_number(earlier)} is no repeat: the interval is too narrow"
        yield Finding("same_scan", words, about=_number(index))
    if pooled.fat_apart_mm is not None:
        yield fat_apart(pooled.fat_apart_mm)
    for text in pooled.outside:
        yield Finding("outside_calibration", f"outside the calibration's range: {text}")
    for index in pooled.outlying:
        yield Finding("outlying", "lies apart from the others: look at this map", about=_number(index))
    for index, document in enumerate(documents):
        for rise in () if one_place else document["other_rises"]:
            text = f"another rise stands at ({rise['x_mm']:.1f}, {rise['y_mm']:.1f}) mm"
            same = "check that every map was sized at the same mass"
            yield Finding("several_masses", text, same, same, _number(index))


def _chances(pooled: PooledEstimate) -> tuple[float, float | None]:
    """Probability of the maps of one mass being so far apart, in place or in size, and that by the paper's spread."""
    if pooled.one_place is not None and pooled.one_place < LEAST_PROBABILITY:
        return pooled.one_place, None
    assert pooled.one_size is not None
    return pooled.one_size, pooled.one_size_apart


def disagreement(what: str, probability: float, if_exams_differ: float | None = None) -> Finding:
    """Caution where maps are not of one size, or not of one mass.

    Parameters
    ----------
    probability, if_exams_differ
        Of maps of one mass that are as far apart or farther, by the spread supposed and by the paper's.
    """
    patients = (
        "" if if_exams_differ is None else f" ({_chance(if_exams_differ)} if exams differ as those of patients did)"
    )
    text = f"{what}; one mass gives maps so far apart with a probability of {_chance(probability)}{patients}"
    on_paper = "look at each map: one may be of another mass or of another day"
    return Finding("maps_disagree", text, f"{on_paper}, or exams differ more at this site (--repeatability)", on_paper)


def _chance(probability: float) -> str:
    return "under 0.001" if probability < 0.001 else f"{probability:.1g}"


def _number(index: int) -> str:
    """A map by its number: a file's name may be a patient's."""
    return f"map {index + 1}"


def fat_apart(depths_mm: tuple[float, float]) -> Finding:
    """Caution where maps differ too much in the depth of fat to be of one breast."""
    text = "the fat under the head is {:.1f} mm deep on one map and {:.1f} mm on another: they may be of two bodies"
    return Finding("fat_apart", text.format(*depths_mm))


def pooled_summary(document: Mapping[str, Any]) -> str:
    """Report of a mass in at most 12 lines; `pooled_text` gives the rest."""
    findings = findings_in(document["findings"])
    apart = document["status"] == DISAGREE
    lines = finding_summary(findings, "caution", most=2) + _maps_lines(document["maps"], with_ends=apart)
    lines += finding_summary(findings, "check", most=2)
    if document["max_size_mm"] is None:
        lines.append(_no_size(document))
    else:
        largest, spread = document["max_size_mm"], document["figures"]["between_map_sd"]
        lines += _table(document) + width_lines(leading(document)["variance_share"])
        ends = f"interval ends to {largest['mc_error'] / largest['sd']:.3f} SD; " if largest["sd"] > 0 else ""
        by = f"sizes by {document['site']}; " if document["site"] else ""
        site = f"; {document['repeatability']}" if "repeatability" in document else ""
        form = "; irregular outline, with a wider interval" if document["figures"].get("irregular_outline") else ""
        lines.append(f"Quality: {by}{ends}the maps of this mass differ by {100 * spread:.0f} %{site}{form}.")
        if len(lines) < MOST_LINES - 2:
            places = decimals(_worst(document)["mc_error"], most=SIZE_DECIMALS)
            lines += supposed_line(document["supposing"], largest["median"], places=places)
    return "\n".join([*lines, MORE, RESEARCH_USE]) + "\n"


def _maps_lines(maps: Sequence[Mapping[str, Any]], *, with_ends: bool) -> list[str]:
    """Sizes of the maps in one line."""
    found = [one for one in maps if one["max_size_mm"] is not None]
    sizes = ", ".join(_size_words(one["max_size_mm"], with_ends=with_ends) for one in found[:MOST_NAMED])
    more = f" and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
    return [f"A lump was found on {len(found)} of {len(maps)} maps, alone sized at {sizes}{more} mm."] if found else []


def _size_words(size: Mapping[str, float], *, with_ends: bool) -> str:
    return f"{size['median']:.1f}" + (f" ({size['low']:.1f} to {size['high']:.1f})" if with_ends else "")


def _no_size(document: Mapping[str, Any]) -> str:
    head = "No common size" if document["status"] == DISAGREE else "No estimate"
    return f"{head}: {document['reason']}."


def pooled_text(document: Mapping[str, Any]) -> str:
    """Full report of a mass."""
    findings = findings_in(document["findings"])
    lines = finding_lines(findings, "caution")
    lines += [f"{number}. {_map_line(one)}" for number, one in enumerate(document["maps"], start=1)]
    lines += finding_lines(findings, "check")
    if document["max_size_mm"] is None:
        return "\n".join([*lines, _no_size(document), RESEARCH_USE]) + "\n"
    worst, figures = _worst(document), document["figures"]
    lines += ["", *_table(document)]
    lines += ["", *width_lines(leading(document)["variance_share"])]
    places = decimals(worst["mc_error"], most=SIZE_DECIMALS)
    lines += supposed_lines(document["supposing"], document["max_size_mm"]["median"], places=places)
    lines.append(f"Spread between the maps of this mass: {100 * figures['between_map_sd']:.0f} %.")
    if document["one_size_probability"] is not None:
        chance = _chance(document["one_size_probability"])
        lines.append(f"Probability that maps of one mass are as far apart in size or farther: {chance}.")
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
        lines.append(_row(label, leading(document)[name], places))
    if document[ANOTHER_EXAM] is not None:
        lines.append(_row(exams_label(document["figures"].get("between_map_sd")), document["max_size_mm"], places))
    return lines


def _row(label: str, q: Mapping[str, float], places: int) -> str:
    return table_row(label, q["median"], (q["low"], q["high"]), unit="mm", places=places)


def _map_line(one: Mapping[str, Any]) -> str:
    size = one["max_size_mm"]
    if size is None:
        return f"{one['map']}: no estimate ({one['reason']})"
    mass = "  (mass {} of {} on this map)".format(*one["mass"]) if one.get("mass") else ""
    return f"{one['map']}: {_size_words(size, with_ends=True)} mm alone{mass}"


def _unknowns(document: Mapping[str, Any]) -> str:
    text = fat_text(document["fat_mm"]) + unknowns_text(document["unknowns"])
    return text[0].upper() + text[1:] + "."
