"""Makes the pictures beside it from photographs in scikit-image's wheel, all CC0 or public domain.

    .venv/bin/python tests/pictures/make.py

coffee: Rachel Michetti, CC0. chelsea: Stefan van der Walt, CC0. rocket: SpaceX, CC0. astronaut:
NASA, public domain. The mixtures add light: background times glass, plus a blurred, doubled
reflection, all in linear light.
"""

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, shift
from skimage import data
from skimage.transform import resize

from brewster.photo import Photo
from brewster.photo.srgb import to_linear

HERE = Path(__file__).parent


def main() -> None:
    coffee, chelsea, rocket, astronaut = (
        to_linear(picture() / 255)
        for picture in (data.coffee, data.chelsea, data.rocket, data.astronaut)
    )
    save("mixture-coffee-rocket", mixture(coffee, rocket, strength=0.45, blur_px=1.0))
    save("mixture-chelsea-astronaut", mixture(chelsea, astronaut[:340], strength=0.35, blur_px=2.5))
    save("plain-astronaut", astronaut)


def mixture(
    background: np.ndarray, mirrored: np.ndarray, *, strength: float, blur_px: float
) -> np.ndarray:
    """A pane between the camera and the background; the second surface's copy is 4 px away."""
    mirrored = resize(mirrored, background.shape, anti_aliasing=True)
    blurred = gaussian_filter(mirrored, (blur_px, blur_px, 0))
    doubled = (blurred + 0.8 * shift(blurred, (1, 4, 0), order=1, mode="nearest")) / 1.8
    return 0.92 * background + strength * doubled


def save(name: str, linear: np.ndarray) -> None:
    Photo.from_array(np.clip(linear, 0, 1).astype(np.float32), encoding="linear").save(
        HERE / f"{name}.jpg"
    )


if __name__ == "__main__":
    main()
