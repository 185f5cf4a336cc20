"""A campaign learns its own repeatability from its repeats, and sizes by it without fitting a map again."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from campaign_files import FAST, JOURNAL, contents, rows_of, steps, thinned, write, write_table
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here

from tactile_bayes.actions import campaign as actions
from tactile_bayes.campaigns import steps as campaign_steps

MASSES, EXAMS = ("01", "02", "03", "04", "05"), (1, 2)
ROWS = [(f"scans/{mass}-{exam}.mcap", mass, exam, "left") for mass in MASSES for exam in EXAMS]
SAYS = "learned from the repeats (repeatability.json)"


def campaign(folder: Path, *more: object, out: str = "out") -> subprocess.CompletedProcess[str]:
    done = run_here("campaign", "run", "exams.csv", "-o", out, *FAST, *more, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five masses with two exams each, after one run that said `said.txt`."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "scans").mkdir()
    for file, mass, exam, side in ROWS:
        write(folder / file, thinned(exam - 1, 3 + int(mass), subject=mass, side=side))
    write_table(folder / "exams.csv", ROWS)
    (folder / "said.txt").write_text(campaign(folder).stdout)
    return folder


@pytest.fixture
def own(study: Path, tmp_path: Path) -> Path:
    """A copy, to be changed."""
    shutil.copytree(study, tmp_path / "study")
    return tmp_path / "study"


@pytest.mark.long
def test_a_campaign_learns_the_spread_and_its_file_is_what_the_command_writes(study: Path, tmp_path: Path) -> None:
    said = (study / "said.txt").read_text()
    assert SAYS in said
    assert "at this site, by 5 masses and 10 exams; every size is by this spread" in said
    run_here("calibrate", "repeatability", study / "out", "-o", "site.json", cwd=tmp_path)
    assert (tmp_path / "site.json").read_bytes() == (study / "out" / "repeatability.json").read_bytes()
    page = (study / "out" / "index.html").read_text()
    assert SAYS in page
    assert 'href="repeatability.json"' in page


@pytest.mark.long
def test_the_tables_have_the_sizes_by_the_learned_spread(study: Path) -> None:
    rows = rows_of(study / "out" / "trial.csv")
    learned = json.loads((study / "out" / "repeatability.json").read_text())
    for row in rows:
        if row["modality"] == "tactile":
            folder = study / "out" / "exams" / f"{row['patient']}.v1.m1.r{row['replicate']}"
            document = json.loads((folder / "sized.json").read_text())
            assert document["diagnostics"]["between_map_sd"] == pytest.approx(learned["between_map_sd"], rel=0.1)
        else:
            folder = study / "out" / "masses" / f"{row['patient']}.v1.m1"
            document = json.loads((folder / "pooled.json").read_text())
        assert document["another_exam"] is None
        assert float(row["low_mm"]) == document["max_size_mm"]["low"]
        settings = document["provenance"]["settings"]["repeatability"]
        assert settings["between_map_sd"] == pytest.approx(learned["between_map_sd"])
    done = rows_of(study / "out" / "exams_done.csv")
    assert [row["low_mm"] for row in done] == [row["low_mm"] for row in rows if row["modality"] == "tactile"]


@pytest.mark.long
def test_a_size_by_it_is_that_of_an_estimate_from_the_map(study: Path) -> None:
    """Two ways: from the kept draws, and the whole estimate with --repeatability."""
    folder = study / "out" / "exams" / "01.v1.m1.r1"
    words = (*FAST, "--repeatability", study / "out" / "repeatability.json", "--json")
    by_hand = json.loads(run_here("estimate", folder / "map.nc", *words, cwd=study).stdout)
    sized = json.loads((folder / "sized.json").read_text())
    for name in ("max_size_mm", "min_size_mm"):
        for end in ("low", "median", "high"):
            assert sized[name][end] == pytest.approx(by_hand[name][end], abs=0.1 * by_hand[name]["sd"])
    same = ("status", "amplitude", "sigma_x_mm", "centre_mm", "detected_probability", "another_exam", "candidates")
    assert {name: sized[name] for name in same} == {name: by_hand[name] for name in same}
    assert sized["diagnostics"].keys() == by_hand["diagnostics"].keys()
    assert sized["diagnostics"]["repeatability"] == by_hand["diagnostics"]["repeatability"]
    assert sized["provenance"] == by_hand["provenance"]


@pytest.mark.long
def test_a_second_run_does_nothing_again(own: Path) -> None:
    before = contents(own / "out")
    assert "0 steps run, 46 kept from earlier runs" in campaign(own).stdout
    assert contents(own / "out") == before


@pytest.mark.long
@pytest.mark.parametrize("done", [20, 26])
def test_what_a_kill_leaves_while_it_learns_or_sizes_goes_on_to_the_same_bytes(done: int, own: Path) -> None:
    """Killed before the spread was in the journal, and between the sizes; files may be there before their lines."""
    before, order = contents(own / "out"), steps(own / "out")
    journal = own / "out" / JOURNAL
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[: 1 + done]) + '{"key": "cut')
    unwritten = ("masses/*/*", "exams/03*r2/sized.json", "exams/0[45]*/sized.json")  # a file comes before its line
    for path in [found for pattern in unwritten for found in (own / "out").glob(pattern)]:
        path.unlink()
    campaign(own)
    assert contents(own / "out") == before
    assert steps(own / "out") == order


@pytest.mark.long
def test_a_changed_exam_redoes_sizes_and_fits_no_other_map(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[int, int]] = []

    def tell(done: int, total: int) -> None:
        told.append((done, total))

    monkeypatch.setattr(actions, "progress_bar", lambda _label, **_: nullcontext(tell))
    count = len(steps(own / "out"))
    write(own / "scans" / "03-2.mcap", thinned(2, 6, subject="03", side="left"))
    campaign(own)
    sizes = [f"size {mass}.v1.m1.r{exam}" for mass in MASSES for exam in EXAMS]
    assert steps(own / "out")[count:] == [
        "map 03.v1.m1.r2",
        "estimate 03.v1.m1.r2",
        "repeatability site",
        *sizes,
        *(one.replace("size", "page") for one in sizes),
        *(f"pool {mass}.v1.m1" for mass in MASSES),
    ]
    assert told[-1] == (28, 28)
    assert (2, 28) in told  # sizes are counted before the spread is learned


@pytest.mark.slow
def test_after_a_changed_exam_all_is_as_if_it_had_been_so_from_the_beginning(own: Path) -> None:
    write(own / "scans" / "03-2.mcap", thinned(2, 6, subject="03", side="left"))
    campaign(own)
    campaign(own, out="fresh")
    assert contents(own / "out") == contents(own / "fresh")


@pytest.mark.long
def test_none_leaves_it_out_and_a_file_or_a_stated_spread_takes_its_place(own: Path) -> None:
    shutil.copy(own / "out" / "repeatability.json", own / "site.json")
    done = campaign(own, "--repeatability", "none")
    assert SAYS not in done.stdout
    assert not (own / "out" / "repeatability.json").exists()
    assert not list((own / "out").glob("exams/*/sized.json"))
    estimate = json.loads((own / "out/exams/01.v1.m1.r1/estimate.json").read_text())
    row = rows_of(own / "out" / "trial.csv")[0]
    assert float(row["low_mm"]) == estimate["max_size_mm"]["low"]
    assert estimate["another_exam"] is not None
    write_table(own / "exams.csv", ROWS[:2])
    campaign(own, "--repeatability", "site.json", out="given")
    document = json.loads((own / "given/exams/01.v1.m1.r1/estimate.json").read_text())
    assert document["diagnostics"]["repeatability"].endswith("by 5 masses and 10 exams")
    (own / "spread.toml").write_text("between_map_sd = 0.1\nfield_cosines = 8\n")
    assert "spread between exams" not in campaign(own, "--settings", "spread.toml", out="stated").stdout


@pytest.mark.long
def test_the_spread_is_not_learned_from_fewer_than_five_masses(own: Path) -> None:
    write_table(own / "exams.csv", ROWS[:9])
    done = campaign(own)
    assert "spread between exams not learned: 4 masses have repeated exams, and it takes 5; intervals" in done.stdout
    assert not (own / "out" / "repeatability.json").exists()
    assert not list((own / "out").glob("exams/0[1-4]*/sized.json"))


@pytest.mark.long
def test_a_dry_run_knows_the_steps(own: Path) -> None:
    words = ("campaign", "run", "exams.csv", "-o", "out", *FAST, "--dry-run")
    told = run_here(*words, cwd=own).stdout
    assert (
        "repeatability: 0 to do, 1 done\nsize: 0 to do, 10 done\npage: 0 to do, 10 done\npool: 0 to do, 5 done\n"
        in told
    )
    write(own / "scans" / "03-2.mcap", thinned(2, 6, subject="03", side="left"))
    told = run_here(*words, cwd=own).stdout
    assert (
        "repeatability: 1 to do, 0 done\nsize: 10 to do, 0 done\npage: 10 to do, 0 done\npool: 5 to do, 0 done\n"
        in told
    )


def first_alone(draw: Callable[..., object]) -> Callable[..., None]:
    """The picture that was drawn first, for every exam."""
    drawn: list[bytes] = []

    def again(*given: object, **named: object) -> None:
        (path,) = (one for one in given if isinstance(one, Path))
        if drawn:
            path.write_bytes(drawn[0])
        else:
            draw(*given, **named)
            drawn.append(path.read_bytes())

    return again


@pytest.mark.long
def test_figures_show_the_size_by_the_learned_spread(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("draw_map", "draw_size"):
        monkeypatch.setattr(campaign_steps, name, first_alone(getattr(campaign_steps, name)))
    campaign(own, "--figures")
    folder = own / "out" / "exams" / "01.v1.m1.r1"
    assert (folder / "sized.png").exists()
    assert 'href="exams/01.v1.m1.r1/sized.png"' in (own / "out" / "index.html").read_text()
