"""Creating a study: pairing, errors, and names and files that do not reveal the method of a
picture.
"""

import hashlib
import json
import re
from collections import Counter
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brewster import Photo
from brewster.errors import BrewsterError, OutputError
from brewster.evaluation.study.assignment import comparison_sequence, draw_practice, draw_trials
from brewster.evaluation.study.create import create_study
from brewster.evaluation.study.study import read_study
from small_studies import make_description, make_study, write_pictures


@pytest.fixture
def folders(tmp_path):
    methods = {
        name: write_pictures(tmp_path / name, seed=seed)
        for seed, name in enumerate(("ours", "RDNet"), 1)
    }
    return write_pictures(tmp_path / "inputs"), methods


def test_reading_a_study_returns_what_was_created(tmp_path):
    study = make_study(tmp_path)
    assert read_study(study.folder) == study
    assert study.description.datasets == ("nature", "real")
    assert [row.name for row in study.description.comparisons] == ["1", "1", "2", "10"]
    assert study.description.pairs == 4  # fewer than the default of 40, because the study has 4
    study.verify_pictures()


def test_the_first_method_or_every_method_is_compared_with_each_other_method(tmp_path):
    names = ("ours", "RDNet", "DSIT")
    assert make_study(tmp_path / "a", methods=names).pairs_of_methods == (
        ("ours", "RDNet"),
        ("ours", "DSIT"),
    )
    assert len(make_study(tmp_path / "b", methods=names, all_pairs=True).pairs_of_methods) == 3


def test_outputs_named_by_brewster_are_found(tmp_path, folders):
    inputs, methods = folders
    for path in sorted(methods["ours"].rglob("*.png")):
        path.rename(path.with_suffix(".transmission.png"))
        write_pictures(path.parent, [path.stem], suffix=".reflection.png")
    assert len(create_study(tmp_path / "study", inputs, methods).description.comparisons) == 4


@pytest.mark.parametrize("layout", [
    "transmission/{dataset}/{stem}", "{dataset}/transmission/{stem}",
    "{dataset}/{stem}/transmission", "transmission_layer/{dataset}/{stem}",
    "{dataset}/transmission_layer/{stem}",
])  # fmt: skip
def test_outputs_in_folders_of_their_layer_or_of_their_photo_are_found(tmp_path, folders, layout):
    inputs, methods = folders
    for path in sorted(methods["ours"].rglob("*.png")):
        name = layout.format(dataset=path.parent.name, stem=path.stem)
        target = tmp_path / "moved" / f"{name}.png"
        for layer in ("transmission", "reflection"):
            other = Path(str(target).replace("transmission", layer))
            other.parent.mkdir(parents=True, exist_ok=True)
            other.write_bytes(path.read_bytes())
    moved = {**methods, "ours": tmp_path / "moved"}
    found, expected = (
        [(row.dataset, row.name) for row in created.description.comparisons]
        for created in (
            create_study(tmp_path / "study", inputs, moved),
            create_study(tmp_path / "other", inputs, methods),
        )
    )
    assert found == expected
    assert len(found) == 4


def test_a_picture_is_copied_without_loss_from_any_format(tmp_path, folders):
    inputs, methods = folders
    (inputs / "real/1.png").unlink()
    write_pictures(inputs, ["real/1"], suffix=".tif", seed=5)
    study = create_study(tmp_path / "study", inputs, methods)
    row = next(
        row for row in study.description.comparisons if (row.dataset, row.name) == ("real", "1")
    )
    copied = Photo.open(study.picture_file(row.photo))
    assert np.array_equal(copied.pixels, Photo.open(inputs / "real/1.tif").pixels)
    description = study.picture(row.photo)
    assert (
        description.source_sha256
        == hashlib.sha256((inputs / "real/1.tif").read_bytes()).hexdigest()
    )
    assert (description.width, description.height) == copied.size


def test_file_names_and_bytes_reveal_neither_method_nor_picture(tmp_path):
    study = make_study(tmp_path)
    files = list((study.folder / "pictures").iterdir())
    assert len(files) == 4 * 3 + 4  # the last 4 are degraded pictures
    for path in files:
        assert re.fullmatch(r"[0-9a-f]{16}\.png", path.name)
        assert not re.search(rb"Secretlus|Rivalino|brewster|tEXt|eXIf|tIME", path.read_bytes())


def test_equal_seeds_make_equal_studies_and_different_seeds_do_not(tmp_path, folders):
    inputs, methods = folders
    first, second, third = (
        create_study(tmp_path / name, inputs, methods, seed=seed).description
        for name, seed in (("a", 5), ("b", 5), ("c", 6))
    )
    assert first == second
    assert not {picture.name for picture in first.pictures} & {
        picture.name for picture in third.pictures
    }


def test_all_problems_of_the_files_are_listed_at_once_and_nothing_is_written(tmp_path, folders):
    inputs, methods = folders
    (methods["ours"] / "real/2.png").unlink()
    (inputs / "nature/1.png").unlink()
    write_pictures(inputs, ["nature/other"])
    write_pictures(methods["RDNet"], ["real/1.png"], size=(12, 18), suffix="")
    (methods["RDNet"] / "real/10.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(BrewsterError) as caught:
        create_study(tmp_path / "study", inputs, methods)
    for place in (
        "ours/real/2",
        "ours/nature/1",
        "RDNet/real/1.png",
        "RDNet/real/10",
        "RDNet/nature/other",
    ):
        assert place in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["RDNet", "inputs", "ours"]


@pytest.mark.parametrize(("options", "message"), [
    ({"datasets": ("wild",)}, "no dataset 'wild'"), ({"pairs": 5}, "5 pairs .* at most 4"),
    ({"catch_trials": 5}, "5 catch trials .* at most 4"),
])  # fmt: skip
def test_options_beyond_the_available_pictures_are_refused(tmp_path, folders, options, message):
    with pytest.raises(BrewsterError, match=message):
        create_study(tmp_path / "study", *folders, **options)


def test_a_study_is_never_overwritten(tmp_path, folders):
    create_study(tmp_path / "study", *folders)
    with pytest.raises(OutputError, match="is not empty"):
        create_study(tmp_path / "study", *folders)


def test_a_changed_picture_is_detected(tmp_path):
    study = make_study(tmp_path)
    study.picture_file(study.description.comparisons[0].outputs[0]).write_bytes(b"other")
    with pytest.raises(BrewsterError, match="missing or changed"):
        study.verify_pictures()


def test_an_invalid_description_is_refused_with_the_key_of_the_error(tmp_path):
    with pytest.raises(BrewsterError, match="cannot be read"):
        read_study(tmp_path)
    study = make_study(tmp_path)
    text = json.loads((study.folder / "study.json").read_text())
    for change, message in (
        ({"pairs": "many"}, "pairs is 'many'; expected an integer"),
        ({"unknown": 1}, "there is no field unknown"),
        ({"format": 1}, "format 1"),
    ):
        (study.folder / "study.json").write_text(json.dumps(text | change))
        with pytest.raises(BrewsterError, match=message):
            read_study(study.folder)


def test_catch_pictures_are_clearly_degraded_outputs(tmp_path):
    study = make_study(tmp_path, size=(96, 72))
    for catch in study.description.catch_pool:
        good, degraded = (
            Photo.open(study.picture_file(name)).pixels.astype(float)
            for name in (catch.good, catch.degraded)
        )
        assert good.shape == degraded.shape
        assert 10 * np.log10(255**2 / np.mean((good - degraded) ** 2)) < 22
        outputs = {name for row in study.description.comparisons for name in row.outputs}
        assert catch.good in outputs
        assert catch.degraded not in outputs


def test_pictures_next_to_subfolders_with_pictures_are_refused_unless_datasets_are_chosen(
    tmp_path, folders
):
    inputs, methods = folders
    write_pictures(inputs, ["stray"])
    with pytest.raises(
        BrewsterError, match=r"stray\.png\) and subfolders with pictures \(nature, real\)"
    ):
        create_study(tmp_path / "study", inputs, methods)
    study = create_study(tmp_path / "study", inputs, methods, datasets=("nature", "real"))
    assert len(study.description.comparisons) == 4


def test_a_picture_named_like_a_layer_is_used_if_there_is_no_transmission_of_its_photo(tmp_path):
    names = ("window.reflection", "window", "b.confidence")
    study = make_study(tmp_path, names=names)
    assert {row.name for row in study.description.comparisons} == set(names)


SIZES = st.integers(1, 60).flatmap(lambda count: st.tuples(st.just(count), st.integers(1, count)))


def assigned_items(count, pairs, seed, participants):
    row = list(islice(comparison_sequence(count, pairs, seed), participants * pairs))
    return [row[i * pairs : (i + 1) * pairs] for i in range(participants)]


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_no_participant_gets_a_comparison_twice_and_counts_differ_by_at_most_one(
    sizes, seed, participants
):
    count, pairs = sizes
    seen = Counter(dict.fromkeys(range(count), 0))
    for items in assigned_items(count, pairs, seed, participants):
        numbers = [comparison for comparison, _ in items]
        assert len(set(numbers)) == pairs
        seen.update(numbers)
        assert max(seen.values()) - min(seen.values()) <= 1


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_left_and_right_counts_of_a_comparison_differ_by_at_most_one(sizes, seed, participants):
    balance = Counter()
    for items in assigned_items(*sizes, seed, participants):
        balance.update({comparison: 1 if flipped else -1 for comparison, flipped in items})
        assert all(abs(value) <= 1 for value in balance.values())


@given(SIZES, st.integers(0, 2**32), st.integers(1, 30))
def test_no_participant_sees_one_method_much_more_often_on_one_side(sizes, seed, participants):
    for items in assigned_items(*sizes, seed, participants):
        right = sum(flipped for _, flipped in items)
        assert abs(2 * right - len(items)) <= 4


def test_a_study_with_the_size_of_the_paper_is_balanced():
    """100 participants; each answers 40 of the 362 comparisons (181 photos, 2 comparisons each)."""
    participants = assigned_items(362, 40, 1, 100)
    rights = [sum(flipped for _, flipped in items) for items in participants]
    assert min(rights) >= 18
    assert max(rights) <= 22
    assert set(
        Counter(comparison for items in participants for comparison, _ in items).values()
    ) == {11, 12}


def test_trials_depend_on_seed_and_number_only():
    study = make_description()
    trials = [draw_trials(study, number) for number in range(6)]
    assert trials == [draw_trials(study, number) for number in range(6)]
    assert len(set(trials)) == 6
    assert draw_trials(make_description(seed=8), 0) != trials[0]


def test_trials_are_the_same_in_every_version():
    """Participants keep their links, and a study may continue after an update of brewster."""
    trials = draw_trials(make_description(pictures=4, pairs=4, catch_trials=0), 0)
    found = [(trial.comparison, trial.flipped) for trial in trials]
    assert found == [(4, False), (1, True), (5, False), (7, True)]


def test_the_pictures_of_a_trial_match_its_comparison_and_sides():
    study = make_description()
    for trial in draw_trials(study, 3):
        if trial.comparison is not None:
            row = study.comparisons[trial.comparison]
            assert row.photo == trial.photo
            assert row.outputs == (
                (trial.right, trial.left) if trial.flipped else (trial.left, trial.right)
            )


def test_catch_trials_have_both_kinds_and_use_photos_of_no_other_trial():
    study = make_description(catch_trials=4)
    pool = {catch.photo for catch in study.catch_pool}
    sides = set()
    for number in range(20):
        trials = draw_trials(study, number)
        catch_trials = [trial for trial in trials if trial.expected]
        assert Counter(trial.left == trial.right for trial in catch_trials) == {True: 2, False: 2}
        others = {trial.photo for trial in trials if not trial.expected}
        assert not {trial.photo for trial in catch_trials} & others
        for trial in catch_trials:
            chosen = {"left": trial.left, "right": trial.right, "similar": trial.left}[
                trial.expected
            ]
            assert chosen == "good"
            assert (trial.expected == "similar") == (trial.left == trial.right)
            assert {trial.left, trial.right} == (
                {"good"} if trial.expected == "similar" else {"good", "degraded"}
            )
            assert trial.photo in pool
            sides.add(trial.expected)
        practice = draw_practice(study, number, trials)
        assert practice == draw_practice(study, number, trials)
        assert practice.expected != "similar"
        assert practice.photo not in {trial.photo for trial in trials}
    assert sides == {"left", "right", "similar"}
    (only,) = [
        trial for trial in draw_trials(make_description(catch_trials=1), 0) if trial.expected
    ]
    assert only.expected == "similar"


def test_the_order_does_not_reveal_the_catch_trials():
    sessions = [draw_trials(make_description(), number) for number in range(120)]
    positions = Counter(
        i for trials in sessions for i, trial in enumerate(trials) if trial.expected
    )
    assert len(positions) == 10
    assert min(positions.values()) > 10


def test_each_half_of_a_session_has_each_comparison_equally_often_and_on_both_sides():
    """Participants tire: the order of presentation must not depend on the comparison or on its
    sides.
    """
    description = make_description(pictures=10, pairs=20, catch_trials=0)
    first_half = Counter()
    flipped_first = Counter()
    for number in range(200):
        trials = draw_trials(description, number)
        first_half.update(trial.comparison for trial in trials[:10])
        flipped_first[trials[0].flipped] += 1
    assert len(first_half) == 20
    assert min(first_half.values()) > 75  # of 200; the standard deviation is 7
    assert len(flipped_first) == 2
    assert min(flipped_first.values()) > 70


def test_each_round_begins_with_another_side():
    starts = Counter(next(comparison_sequence(6, 3, seed))[1] for seed in range(100))
    assert len(starts) == 2
    assert min(starts.values()) > 30
