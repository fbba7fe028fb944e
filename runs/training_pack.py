"""Packs the training data for a machine without a network, in tar files of at most 30 MB, together
at most 60 MB.

    BREWSTER_DATA=../shared/data .venv/bin/python runs/training_pack.py out/pack
    # on the other machine: unpack all files into data/, then
    BREWSTER_DATA=data brewster train recipes/train/refined.toml -o out/refined

Photos have at most 512 px and maps 256 px on the longer side. The development pairs have 384 px,
the size at which training validates.
"""

import io
import os
import sys
import tarfile
from pathlib import Path

from brewster import Photo

MAX_PART_BYTES = 30_000_000
FOLDERS = {  # folder -> longest side in pixels, suffix, options of the file
    "photos/permissive": (512, ".webp", {"quality": 60}),
    "hdri": (256, ".hdr", {}),
    "real/dev": (384, ".webp", {"quality": 95}),
}


def reduced(path, side_px, suffix, options):
    """The file of a smaller copy."""
    photo = Photo.open(path)
    scale = min(1.0, side_px / max(photo.size))
    light = photo.resized(*(max(1, round(length * scale)) for length in photo.size))
    return Photo.from_array(light, encoding="linear").encode(suffix[1:], **options)


def main(data, out):
    out.mkdir(parents=True, exist_ok=True)
    entries = []
    for folder, (side_px, suffix, options) in FOLDERS.items():
        for path in sorted(
            path for path in (data / folder).rglob("*") if path.suffix not in ("", ".csv")
        ):
            name = path.relative_to(data).with_suffix(suffix).as_posix()
            entries.append((name, reduced(path, side_px, suffix, options)))
    for number, part in enumerate(parts(entries), start=1):
        with tarfile.open(out / f"part{number}.tar", "w") as tar:
            for name, content in part:
                info = tarfile.TarInfo(name)
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))


def parts(entries):
    """Lists of entries that fit into one file."""
    size = 0
    part = []
    for name, content in entries:
        size += len(content) + 1024  # the header, and the rest of the last block
        if size > MAX_PART_BYTES:
            yield part
            size = len(content) + 1024
            part = []
        part.append((name, content))
    yield part


if __name__ == "__main__":
    main(Path(os.environ["BREWSTER_DATA"]), Path(sys.argv[1]))
