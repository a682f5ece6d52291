"""Makes carpet.png, the reflectance of the masking scene: ``python -m benchmarks.scenes.carpet``.

A carpet from above: tufts of yarn on a jittered grid, each of its own brightness, brighter at its
tip than at its rim, over broader stains. Its energy lies over several octaves and all
orientations, as Section 4.1 of Bolin and Meyer 1999 says of theirs.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FILE = Path(__file__).with_name("carpet.png")

# Texels; twice as high as wide, as its rectangle is. Status: choice.
WIDTH, HEIGHT = 256, 512

# Texels between tufts: 2.4 pixels where the frame has 64. Status: choice.
PITCH = 24

# Reflectance of the darkest and the brightest yarn. Status: choice.
DARKEST, BRIGHTEST = 0.06, 0.9

SEED = 1999


def carpet() -> NDArray[np.uint8]:
    """Return the linear reflectance, (HEIGHT, WIDTH), 255 for 1."""
    rng = np.random.default_rng(SEED)
    # A tuft in each cell of a grid that is larger by one cell on each side.
    rows, columns = HEIGHT // PITCH + 3, WIDTH // PITCH + 3
    y0, x0 = np.mgrid[0:rows, 0:columns].reshape(2, -1, 1) - 1.0
    y0, x0 = ((axis + rng.uniform(0.0, 1.0, axis.shape)) * PITCH for axis in (y0, x0))
    # Yarn of every brightness; stains of 8 tufts across make neighbours alike.
    stains = _stains(rng, rows, columns)
    level = np.clip(0.5 * stains + 0.5 * rng.uniform(0.0, 1.0, stains.shape), 0.0, 1.0)
    brightness = (DARKEST * (BRIGHTEST / DARKEST) ** level).reshape(-1)
    image = np.empty((HEIGHT, WIDTH))
    x = np.arange(WIDTH) + 0.5
    for y in range(HEIGHT):
        distance = np.hypot(x0 - x, y0 - (y + 0.5))
        nearest = distance.argmin(0)
        # A tip of full brightness; the rim, half a pitch away, is in shadow.
        shade = 1.0 - 0.6 * np.minimum(distance.min(0) / (0.7 * PITCH), 1.0) ** 2
        image[y] = brightness[nearest] * shade
    return np.round(255.0 * image).astype(np.uint8)


def _stains(rng: np.random.Generator, rows: int, columns: int) -> NDArray[np.float64]:
    """Return noise that changes over about 8 tufts, (rows, columns), about 0 to 1."""
    coarse = rng.uniform(-0.3, 1.3, (rows // 8 + 3, columns // 8 + 3))
    y, x = np.arange(rows) / 8.0, np.arange(columns) / 8.0
    across = np.stack([np.interp(x, np.arange(coarse.shape[1]), row) for row in coarse])
    down = [np.interp(y, np.arange(coarse.shape[0]), column) for column in across.T]
    return np.stack(down, -1)


if __name__ == "__main__":
    from PIL import Image

    Image.fromarray(carpet()).save(FILE, optimize=True)
