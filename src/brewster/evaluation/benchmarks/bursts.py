"""Finds bursts with ground truth: several photos of one window by a moving camera, and the layers
of the middle photo.

A burst is a folder with frame1.jpg, frame2.jpg ... and transmission3.jpg, reflection3.jpg for frame
3, or in a dataset of `render --burst`.
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from brewster.errors import PhotoError
from brewster.evaluation.benchmarks.image_files import Case, ImageFile, files_of, read_samples
from brewster.evaluation.benchmarks.pairing import FolderListing, image_files, list_folder

_ROLE: Final = re.compile(r"(frame|transmission|reflection)[-_ ]?([0-9]+)", re.IGNORECASE)
_RENDERED: Final = re.compile(r"shard-[0-9]{6,}\.tar|set\.toml")
_LAYERS: Final = ("transmission", "reflection")
_LAYER_FILES: Final = ("photo.jpg", "transmission.jpg", "reflection.jpg")


def find_bursts(folder: Path, benchmark: str) -> tuple[list[Case], FolderListing]:
    """Returns a case for each burst in a folder, and a listing without groups: what is ignored and
    excluded. Raises PhotoError if the folder cannot be read, or contains no burst; RecipeError if
    the folder is a rendered dataset of single photos, or a scene file is damaged; MissingExtra if
    torch is not installed, which rendered datasets need.
    """
    folders, files = list_folder(folder)
    samples = (
        path
        for path in folders
        if re.fullmatch("[0-9]{6,}", path.name) and (path / "scene.toml").is_file()
    )
    if any(_RENDERED.fullmatch(path.name) for path in files) or any(samples):
        return _rendered_bursts(folder, benchmark)
    bursts = []
    remarks = []
    excluded = []
    for path in [folder, *folders]:
        roles = _read_roles(path)
        if not roles["frame"]:
            remarks += [f"{path.name} has no frames"] if path != folder else []
        elif reason := _exclusion_reason(roles):
            excluded.append(f"{path.name}: {reason}")
        else:
            bursts.append(_burst(benchmark, folder, path, roles))
    if not bursts and not excluded:
        raise PhotoError(
            f"{folder} contains no burst",
            "expected folders with frame1.jpg, frame2.jpg ... and transmission2.jpg, or a "
            "dataset of `render --burst`",
            "give the path of the parent folder of the bursts",
        )
    return bursts, FolderListing(folder, remarks=remarks, excluded=excluded)


_Roles = Mapping[str, Mapping[int, list[Path]]]


def _read_roles(folder: Path) -> _Roles:
    """Returns the images of a folder by role and by the number in the name."""
    roles: dict[str, dict[int, list[Path]]] = {
        role: defaultdict(list) for role in ("frame", *_LAYERS)
    }
    for path in image_files(folder)[0]:
        if match := _ROLE.fullmatch(path.stem):
            roles[match[1].lower()][int(match[2])].append(path)
    return roles


def _exclusion_reason(roles: _Roles) -> str:
    for role, files in roles.items():
        for number, paths in files.items():
            if len(paths) > 1:
                return f"{role} {number} is ambiguous: {paths[0].name} and {paths[1].name}"
    if len(roles["frame"]) < 2:
        return "expected two or more frames, but there is one"
    middle = sorted(roles["frame"])[len(roles["frame"]) // 2]
    missing = f"there is no transmission of the middle frame, frame {middle}"
    return "" if middle in roles["transmission"] else missing


def _burst(benchmark: str, root: Path, folder: Path, roles: _Roles) -> Case:
    numbers = sorted(roles["frame"])
    middle = numbers[len(numbers) // 2]
    name = folder.absolute().name
    path = roles["frame"][middle][0].relative_to(root).with_suffix("").as_posix()
    frames = {number: ImageFile(roles["frame"][number][0]) for number in numbers}
    photo = frames[middle]
    truth = ImageFile(roles["transmission"][middle][0])
    reflection = (
        ImageFile(roles["reflection"][middle][0]) if middle in roles["reflection"] else None
    )
    return Case(
        benchmark, name, name, path, photo, truth, reflection, frames=tuple(frames.values())
    )


def _rendered_bursts(folder: Path, benchmark: str) -> tuple[list[Case], FolderListing]:
    samples = {sample.index: sample.name for sample in read_samples(folder)}
    from brewster.render.dataset.store import read_bursts  # noqa: PLC0415  (needs torch, which read_samples has checked)

    cases = []
    excluded = []
    for burst in read_bursts(folder):
        reference = burst.frames[burst.reference]
        layers = files_of(reference, _LAYER_FILES)
        frames = [file for frame in burst.frames for file in files_of(frame, ["photo.jpg"])]
        for frame in burst.frames:
            del samples[frame.index]
        if len(layers) < len(_LAYER_FILES) or len(frames) < len(burst.frames):
            excluded.append(
                f"burst {burst.index} is incomplete: expected {', '.join(_LAYER_FILES)}"
            )
            continue
        photo, transmission, reflection = layers
        name = f"burst-{burst.index:06d}"
        path = f"{reference.name}/photo"
        cases.append(
            Case(benchmark, name, name, path, photo, transmission, reflection, frames=tuple(frames))
        )
    excluded += [f"{name} is a frame of an incomplete burst" for name in samples.values()]
    return cases, FolderListing(folder, excluded=excluded)
