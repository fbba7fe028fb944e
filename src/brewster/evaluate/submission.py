"""Packs predictions in the form that a contest takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from brewster.benchmarks.image_files import Case, ImageFile
from brewster.benchmarks.pairing import find_numbered_splits, image_files
from brewster.errors import BrewsterError, PhotoError
from brewster.evaluate.methods import Method, ModelMethod
from brewster.files import write_atomically
from brewster.photo import Photo
from brewster.photo.open_raster import zip_images

_JPEG_QUALITY: Final = 100
"""The contest's script reads JPEG files only. At quality 100 without chroma subsampling, they are close to lossless."""
_BENCHMARK: Final = "openrr"


def openrr_folder(benchmarks: Sequence[tuple[str, str]], *, has_method: bool) -> Path:
    """Returns the folder of OpenRR-5k among the benchmarks, as (name, folder). Raises BrewsterError if there is not
    exactly one benchmark openrr, or there is no method whose predictions can be packed."""
    folders = [Path(folder) for name, folder in benchmarks if name == _BENCHMARK]
    if len(folders) != 1:
        raise BrewsterError(
            f"the export needs one benchmark openrr, not {len(folders)}",
            "expected --benchmark openrr=FOLDER with the folders val_300_blended and test_100_blended",
            "give the benchmark once, or leave out --export",
        )
    if not has_method:
        raise BrewsterError(
            "the export has no method to pack",
            "expected --model or --predictions, because the unprocessed input is not packed",
            "add a method, or leave out --export",
        )
    return folders[0]


def export_ntire2026(
    folder: Path, method: Method, out: Path, *, on_progress: Callable[[str], None] = lambda _name: None
) -> list[Path]:
    """Predicts all photos of the folders val_*_blended and test_*_blended of OpenRR-5k, writes a zip file for each, and
    returns their paths. The README of OpenRR-5k asks for val_300_output.zip and test_100_output.zip with images only,
    and its evaluate.py reads files "*.jpg" with the names of the photos.
    Raises PhotoError if the folder has another layout or a photo cannot be read; BrewsterError if the method fails on a
    photo; OutputError."""
    splits = {
        name: roles["photo"]
        for name, roles in find_numbered_splits(folder).items()
        if "photo" in roles and not name.startswith("train")
    }
    if not splits:
        raise PhotoError(
            f"{folder} has no folder such as val_300_blended",
            "expected the folders val_300_blended and test_100_blended of OpenRR-5k",
            "give the path of their parent folder with --benchmark openrr=FOLDER",
        )

    # The scored predictions may have another size or quality, and stay as they are.
    if isinstance(method, ModelMethod):
        method = replace(method, folder=out / "predictions")

    def predictions(split: str, photos: Path) -> Iterator[tuple[str, bytes]]:
        for path in image_files(photos)[0]:
            on_progress(path.stem)
            yield f"{path.stem}.jpg", _prediction(split, photos, path, method)

    paths = {split: out / f"{split}_output.zip" for split in splits}
    for split, photos in splits.items():
        write_atomically(paths[split], zip_images(predictions(split, photos)), overwrite=True)
    return list(paths.values())


def _prediction(split: str, photos: Path, path: Path, method: Method) -> bytes:
    # Photos of the test split have no ground truth. `Method` does not read it, so the photo takes its place.
    benchmark = _BENCHMARK if split.startswith("val") else f"{_BENCHMARK}-{split}"
    file = ImageFile(path)
    case = Case(benchmark, path.stem, path.stem, f"{photos.name}/{path.stem}", file, file)
    output = method.predict(case, Photo.open(file.read()))
    pixels = Photo.from_array(output.transmission.srgb_8bit(), encoding="srgb")
    info = replace(pixels.file_info, jpeg_quality=_JPEG_QUALITY, subsampling="4:4:4")
    return replace(pixels, file_info=info).encode("jpeg")
