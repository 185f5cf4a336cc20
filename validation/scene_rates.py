"""How often each structure of a scene is reported, true or not: ``python -m validation scene_rates``.

Prints the table of docs/decisions/0055. Every map goes the whole way through `estimate_map`. A structure is found where
the report says that the map supports it (`Structure.supported`): odds above 3 for an ellipse, a rotation, a tilt or a
departure from a Gaussian; above 10, and a rise of 5 % of the lump's amplitude, for a second lump or a rib. Oval is an
ellipse or a rotation. Another rise is one that `other_rises` names. A lump is found where a size is given; a map
without a size is one on which nothing was found.

Lumps have an amplitude of 0.3 and sigma 5 mm (geometric mean). Errors are 0.01 from cell to cell and a field of 0.01
with a correlation length of 1.5 to 12 mm, a thirtieth of the amplitude each; or as large and long as `sbc` draws them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import cell_mean_gaussian
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.masses import other_rises
from tactile_bayes.posterior.window import LENGTHS_MM
from tactile_bayes.studies.sbc import draw_field, draw_truth
from validation.common import Table, parser, percent

HALF_MM, RADIUS_MM = 35.0, 20.0
AXIS = np.arange(-HALF_MM, HALF_MM + 0.5)
AMPLITUDE, SIGMA_MM, NOISE_SD = 0.3, 5.0, 0.01
RATIO = 1.33
SLOPE = 0.03
"""Of the level over half a window: a tenth of the amplitude."""
COLUMNS = ("lump", "oval", "ellipse", "rotated", "tilt", "second lump", "rib", "departure", "another rise")
Draw = Callable[[np.random.Generator], FloatArray]


@dataclass(frozen=True, slots=True)
class Truths:
    """One row: what is on the maps, and which columns name it."""

    name: str
    values: Draw
    present: tuple[str, ...]
    any_noise: bool = False


def bump(rng: np.random.Generator, *, ratio: float = 1.0) -> FloatArray:
    """A lump near the middle; its long axis along one of the head's."""
    sigmas = rng.permutation(SIGMA_MM * np.sqrt([ratio, 1.0 / ratio]))
    return AMPLITUDE * gaussian(*rng.uniform(-4.0, 4.0, 2), sigmas=sigmas)


def gaussian(x: float, y: float, *, sigmas: FloatArray) -> FloatArray:
    """(n, n) cell means of a Gaussian of unit height."""
    u, v = np.meshgrid(AXIS, AXIS)
    covariance = np.diag(np.square(sigmas))
    cells = cell_mean_gaussian((u - x).ravel(), (v - y).ravel(), covariance_mm2=covariance, cell_mm=1.0)
    return cells.reshape(u.shape)


def slope(rng: np.random.Generator) -> FloatArray:
    """A level that rises by `SLOPE` over half a window, in any direction."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return SLOPE / RADIUS_MM * (np.cos(angle) * AXIS + np.sin(angle) * AXIS[:, None])


def second_lump(rng: np.random.Generator) -> FloatArray:
    """A lump of sigma 4 mm, 16 to 22 mm from the middle, a third to the whole of the amplitude."""
    away, angle = rng.uniform(16.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)
    height = AMPLITUDE * rng.uniform(1.0 / 3.0, 1.0)
    return height * gaussian(away * np.cos(angle), away * np.sin(angle), sigmas=np.array([4.0, 4.0]))


def far_apart(rng: np.random.Generator) -> FloatArray:
    """A lump and another, 30 to 40 mm away and a sixth to the whole as high: outside the window, on the map."""
    half, angle = rng.uniform(15.0, 20.0), rng.uniform(0.0, 2.0 * np.pi)
    x, y = half * np.cos(angle), half * np.sin(angle)
    other = rng.uniform(1.0 / 6.0, 1.0) * gaussian(-x, -y, sigmas=np.array([4.0, 4.0]))
    return np.asarray(AMPLITUDE * (gaussian(x, y, sigmas=np.array([SIGMA_MM, SIGMA_MM])) + other))


def rib(rng: np.random.Generator) -> FloatArray:
    """A ridge of sigma 5 mm, 16 to 22 mm from the middle, a third to the whole of the amplitude."""
    away, angle = rng.uniform(16.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)
    return AMPLITUDE * rng.uniform(1.0 / 3.0, 1.0) * ridge(away, angle)


def ridge(away: float, angle: float) -> FloatArray:
    """(n, n) values of a straight ridge of unit height and sigma 5 mm."""
    distance = np.cos(angle) * AXIS + np.sin(angle) * AXIS[:, None] - away
    return np.asarray(np.exp(-0.5 * (distance / 5.0) ** 2))


def rib_anywhere(rng: np.random.Generator) -> FloatArray:
    """A ridge up to 22 mm from the middle, a third to the whole of the amplitude of a lump that is not there."""
    away, angle = rng.uniform(0.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)
    return AMPLITUDE * rng.uniform(1.0 / 3.0, 1.0) * ridge(away, angle)


def two_ribs(rng: np.random.Generator) -> FloatArray:
    """Two of them side by side, 20 to 26 mm apart, each as high as it happens to be."""
    first, apart, angle = rng.uniform(-20.0, 0.0), rng.uniform(20.0, 26.0), rng.uniform(0.0, 2.0 * np.pi)
    heights = AMPLITUDE * rng.uniform(1.0 / 3.0, 1.0, 2)
    return np.asarray(heights[0] * ridge(first, angle) + heights[1] * ridge(first + apart, angle))


def flatter(rng: np.random.Generator) -> FloatArray:
    """A round lump with an exponent of 2.5 for a Gaussian's 2, at the cells' centres."""
    x, y = rng.uniform(-4.0, 4.0, 2)
    square = ((AXIS - x) ** 2 + (AXIS[:, None] - y) ** 2) / SIGMA_MM**2
    return np.asarray(AMPLITUDE * np.exp(-((square / 2.0) ** 1.25)))


def flat(_: np.random.Generator) -> FloatArray:
    """Nothing."""
    return np.zeros((len(AXIS), len(AXIS)))


ROWS = (
    Truths("round", bump, ("lump",)),
    Truths("ellipse 1.33:1, along an axis", lambda rng: bump(rng, ratio=RATIO), ("lump", "oval", "ellipse")),
    Truths("round on a slope", lambda rng: bump(rng) + slope(rng), ("lump", "tilt")),
    Truths("no lump", flat, ()),
    Truths("no lump, errors of any size and length", slope, ("tilt",), any_noise=True),
    Truths("round and a second lump", lambda rng: bump(rng) + second_lump(rng), ("lump", "second lump")),
    Truths("round and a rib", lambda rng: bump(rng) + rib(rng), ("lump", "rib")),
    Truths("a rib and no lump", rib_anywhere, ("rib",)),
    Truths("two ribs and no lump", two_ribs, ("rib",)),
    Truths("round, flatter than a Gaussian", flatter, ("lump", "departure")),
    Truths("round and another far away", far_apart, ("lump", "another rise")),
)


def draw_map(row: Truths, rng: np.random.Generator) -> TactileMap:
    """One map: what the row says, on a level of 1 with errors."""
    length_mm, share, noise_sd = float(rng.choice(LENGTHS_MM)), 1.0, NOISE_SD
    if row.any_noise:
        truth = draw_truth(rng, BumpPrior())
        length_mm, share, noise_sd = truth.length_mm, truth.share, truth.noise_sd
    white = noise_sd * rng.standard_normal((len(AXIS), len(AXIS)))
    field = np.sqrt(share) * noise_sd * draw_field(AXIS, rng, length_mm=length_mm)
    return TactileMap(
        mean=1.0 + row.values(rng) + white + field,
        variance=np.zeros(white.shape),
        count=np.full(white.shape, 40),
        x_mm=AXIS,
        y_mm=AXIS,
        recipe=MapRecipe("grid", "mean", 1.0),
        background=1.0,
    )


def found_on(tactile_map: TactileMap, rng: np.random.Generator) -> set[str]:
    """Names of `COLUMNS` that the report of one map would have."""
    options = SamplerSettings(method="laplace", background="free", fit_radius_mm=RADIUS_MM, noise="field", draws=1000)
    answer = estimate_map(tactile_map, calibration=None, options=options, rng=rng)
    others = {"another rise"} if any(other_rises(tactile_map, answer, options)) else set()
    if answer.scene is None:
        return others
    found = {"lump"} | others | {one.name for one in answer.scene.structures if one.supported}
    return found | {"oval"} if found & {"ellipse", "rotated"} else found


def counts(row: Truths, *, maps: int, seed: int) -> Counter[str]:
    """On how many of `maps` maps each structure was found."""
    number: Counter[str] = Counter()
    for index in range(maps):
        rng = np.random.default_rng([seed, ROWS.index(row), index])
        number.update(found_on(draw_map(row, rng), rng))
    return number


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table as Markdown; what is on the maps of a row is set in bold."""
    words = parser(__name__, __doc__)
    words.add_argument("--maps", type=int, default=200, help="of each truth (200)")
    words.add_argument("--seed", type=int, default=1999)
    words.add_argument("--only", type=int, action="append", choices=range(len(ROWS)), help="this row; may be repeated")
    given = words.parse_args(arguments)
    table = Table("scene-rates", f"{given.maps} maps each: % found", *COLUMNS)
    for row in (ROWS[i] for i in given.only or range(len(ROWS))):
        number = counts(row, maps=given.maps, seed=given.seed)
        cells = [percent(number[name], given.maps, 1).replace(" %", "") for name in COLUMNS]
        table.add(
            row.name,
            *(f"**{cell}**" if name in row.present else cell for name, cell in zip(COLUMNS, cells, strict=True)),
        )
