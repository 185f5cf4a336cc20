"""Settings of `estimate` from a file: what is given is used, what is not known or not possible is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactile_bayes.api.settings import Settings, read_settings
from tactile_bayes.declarations import to_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_schema
from tactile_bayes.options import PRIORS, BumpPrior
from tactile_bayes.presets import FIELD_COSINES, FINE_FIELD_COSINES, MOST_FIELD_COSINES


def written(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_missing_key_keeps_its_default(tmp_path: Path) -> None:
    path = written(tmp_path, 'width_median_mm = 4\nnoise = "field"\ncheckpoint = "c.npz"\nfield_cosines = "auto"\n')
    found = read_settings(path)
    assert found == {
        "width_median_mm": 4.0,
        "noise": "field",
        "checkpoint": tmp_path / "c.npz",
        "field_cosines": "auto",
        "settings_file": path,
    }
    assert Settings(**found).rotation == Settings().rotation == "auto"
    assert Settings(**found).prior == BumpPrior(width_median_mm=4.0)


def test_the_schema_has_every_key_with_the_programs_defaults() -> None:
    properties = load_schema("settings.schema.json")["properties"]
    assert {name: properties[name]["default"] for name in PRIORS} == to_plain(BumpPrior())
    assert set(properties) - {*PRIORS} <= set(Settings.__struct_fields__)
    cosines = properties["field_cosines"]
    assert cosines["anyOf"][0]["maximum"] == MOST_FIELD_COSINES
    assert f"auto: {FIELD_COSINES}, up to {FINE_FIELD_COSINES}" in cosines["description"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("widht_median_mm = 4", "widht_median_mm is not known; did you mean width_median_mm"),
        ("width_median_mm = -4", "width_median_mm is -4; give a number above 0"),
        ("width_median_mm = nan", "width_median_mm is nan"),
        ("tilt_sd = inf", "tilt_sd"),
        ('amplitude_sd = "2"', "amplitude_sd is '2'; give a number above 0 up to 1000"),
        ("amplitude_sd = ", "is not TOML"),
        ("fit_radius_mm = 0", "fit_radius_mm is 0; give a number above 0"),
        ("fit_radius_mm = inf", "fit_radius_mm is inf"),
        ("accuracy_mm = nan", "accuracy_mm is nan"),
        ("between_map_sd = -1", "between_map_sd is -1; give a number from 0 to 2"),
        ("field_cosines = 5", "field_cosines"),
        ("max_steps = 149", "max_steps is 149; give a whole number from 150 on"),
        ('noise = "white"', "noise is 'white'; give one of independent, field"),
        ('method = "laplace"', "method is not known"),
    ],
)
def test_a_bad_setting_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(BadDataError, match=message) as caught:
        read_settings(path)
    assert "\n" not in str(caught.value)
    assert "settings.toml" in str(caught.value)


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match=r"nothing\.toml"):
        read_settings(tmp_path / "nothing.toml")
