"""Small studies for tests: one without picture files, and one with small pictures."""

import numpy as np

from brewster import Photo
from brewster.evaluation.study.create import create_study
from brewster.evaluation.study.study import (
    PICTURES_FOLDER,
    CatchTrial,
    PairedComparison,
    Study,
    StudyDescription,
    StudyPicture,
)

NAMES = ("real/1", "real/2", "real/10", "nature/1")


def make_description(
    pictures=20,
    *,
    methods=("ours", "RDNet"),
    datasets=("real", "nature"),
    pairs=8,
    catch_trials=2,
    seed=7,
):
    """Has no picture files, but `pictures` photos in each dataset; compares the first method with
    each other.
    """
    photos = [(dataset, str(i), f"{dataset}-{i}") for dataset in datasets for i in range(pictures)]
    comparisons = [
        PairedComparison(
            dataset, name, (methods[0], other), photo, (f"{photo}-a", f"{photo}-{other}")
        )
        for dataset, name, photo in photos
        for other in methods[1:]
    ]
    names = {name for row in comparisons for name in (row.photo, *row.outputs)}
    return StudyDescription(
        brewster="0", seed=seed, pairs=pairs, catch_trials=catch_trials, consent="The consent "
                                                                                 "text.",
        methods=tuple(methods), datasets=tuple(datasets), comparisons=tuple(comparisons),
        pictures=tuple(StudyPicture(name, 3, 2, "", "") for name in sorted(names)),
        catch_pool=tuple(CatchTrial(*photo, "good", "degraded") for photo in photos),
    )  # fmt: skip


def make_empty_study(folder, **options):
    """A study in a folder, without picture files."""
    folder.mkdir(parents=True, exist_ok=True)
    return Study(folder, make_description(**options))


def write_pictures(folder, names=NAMES, *, size=(24, 18), suffix=".png", seed=0):
    rng = np.random.default_rng(seed)
    for name in names:
        path = folder / f"{name}{suffix}"
        picture = np.kron(rng.integers(0, 256, (3, 4, 3)), np.ones((size[1] // 3, size[0] // 4, 1)))
        Photo.from_array(picture.astype(np.uint8), encoding="srgb").save(path, overwrite=True)
    return folder


def make_study(folder, *, methods=("Secretlus", "Rivalino"), names=NAMES, size=(24, 18), **options):
    """A study of small pictures, with its files."""
    inputs = write_pictures(folder / "inputs", names, size=size)
    outputs = {
        name: write_pictures(folder / name, names, size=size, seed=seed)
        for seed, name in enumerate(methods, 1)
    }
    return create_study(folder / "study", inputs, outputs, **{"seed": 3} | options)


def choice_for(trial, outcome):
    """The choice that gives this outcome (0, 1, 2) for the first method of the comparison."""
    if outcome == 1:
        return "similar"
    return "left" if (outcome == 0) != trial.flipped else "right"


def copy_without_answers(study, folder):
    """The same study in another folder, without answers; the folder links to the pictures."""
    folder.mkdir()
    (folder / PICTURES_FOLDER).symlink_to(study.folder / PICTURES_FOLDER)
    return Study(folder, study.description)
