"""Images are grouped by file name only. All other files are reported."""

import os
import random
import tempfile
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmark_folders import postcard, repacked, solidobject, wildscene, write
from brewster.errors import PhotoError, RecipeError
from brewster.evaluation.benchmarks import pairing
from brewster.training.data.image_loading import read_pairs

STEMS = st.sets(
    st.sampled_from(["1", "2", "02", "10", "a-1", "a-10", "a_1", "ä", "x.y", "m"]), min_size=1
)


def names(found):
    return [group.name for group in found.groups]


@pytest.mark.parametrize("roles", [
    ("blended", "transmission_layer", "reflection_layer"), ("I", "T", "R"),
    ("Input", "GT", "Reflection"), ("With Reflection", "Ground-Truth", "reflection"),
])  # fmt: skip
def test_roles_are_recognised_by_the_names_of_their_folders(tmp_path, roles):
    repacked(tmp_path, ["1", "2"], roles)
    found = pairing.read_folders(tmp_path)
    assert names(found) == ["1", "2"]
    assert found == pairing.FolderListing(tmp_path, found.groups)
    for group in found.groups:
        pictures = (group.photo, group.transmission, group.reflection)
        assert pictures == tuple(tmp_path / role / f"{group.name}.png" for role in roles)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders")
def test_a_pipe_in_a_folder_of_pairs_is_not_listed(tmp_path):
    (tmp_path / "a.jpg").touch()
    os.mkfifo(tmp_path / "b.jpg")
    assert pairing.list_folder(tmp_path) == ([], [tmp_path / "a.jpg"])


def test_no_folder_name_belongs_to_two_roles():
    folder_names = [name for names in pairing.ROLES.values() for name in names]
    assert len(folder_names) == len(set(folder_names))
    assert folder_names == [name.lower() for name in folder_names]


@settings(max_examples=40)
@given(photos=STEMS, ground_truths=STEMS, reflections=STEMS, order=st.randoms())
def test_only_equal_names_make_a_pair_and_all_others_are_excluded(
    photos, ground_truths, reflections, order
):
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        stems_by_role = {"blended": photos, "gt": ground_truths, "reflection": reflections}
        paths = [f"{role}/{stem}.png" for role, stems in stems_by_role.items() for stem in stems]
        order.shuffle(paths)
        write(root, *paths)
        found = pairing.read_folders(root)
        assert set(names(found)) == photos & ground_truths
        assert names(found) == sorted(photos & ground_truths, key=pairing.natural_key)
        for group in found.groups:
            assert group.photo.stem == group.transmission.stem == group.name
            assert (group.reflection is not None) == (group.name in reflections)
        for stem in (photos | ground_truths | reflections) - (photos & ground_truths):
            assert any(f"/{stem}.png" in line and "no partner" in line for line in found.excluded)
        assert len(found.excluded) == len(
            (photos | ground_truths | reflections) - (photos & ground_truths)
        )


@pytest.mark.parametrize("role", ["blended", "gt", "reflection"])
def test_two_images_with_the_same_name_and_role_are_both_excluded(tmp_path, role):
    repacked(tmp_path, ["a", "b"], ("blended", "gt", "reflection"))
    write(tmp_path, f"{role}/a.jpg")
    found = pairing.read_folders(tmp_path)
    assert names(found) == ["b"]
    assert len(found.excluded) == 1
    assert found.excluded[0].startswith(f"{role}/a.jpg and {role}/a.png are ambiguous")


def test_suffixes_may_differ_and_names_in_both_unicode_forms_are_equal(tmp_path):
    write(tmp_path, "blended/a.JPG", "gt/a.png", "blended/b.tif", "gt/b.webp")
    write(tmp_path, f"blended/{unicodedata.normalize('NFC', 'café')}.png")
    write(tmp_path, f"gt/{unicodedata.normalize('NFD', 'café')}.png")
    found = names(pairing.read_folders(tmp_path))
    assert [unicodedata.normalize("NFC", name) for name in found] == ["a", "b", "café"]


def test_system_files_are_ignored_silently_and_other_files_with_a_remark(tmp_path):
    repacked(tmp_path, ["a"])
    write(tmp_path, "blended/._a.png", "blended/thumbs.db", ".hidden/x.png", "__MACOSX/a.png")
    assert pairing.read_folders(tmp_path).remarks == []
    write(tmp_path, "blended/README.txt", "transmission_layer/old/a.png", "licence.md")
    (remark,) = pairing.read_folders(tmp_path).remarks
    assert remark == "ignored blended/README.txt, transmission_layer/old and licence.md"
    assert names(pairing.read_folders(tmp_path)) == ["a"]


def test_a_split_is_the_folder_itself_or_the_only_one_in_it(tmp_path):
    repacked(tmp_path / "val", ["a"])
    (tmp_path / "other").mkdir()
    assert pairing.find_split(tmp_path) == pairing.find_split(tmp_path / "val") == tmp_path / "val"
    repacked(tmp_path / "test", ["a"])
    with pytest.raises(
        PhotoError, match=r"has pairs in the subfolders test and val; .*, for example .*test"
    ):
        pairing.find_split(tmp_path)


def test_the_original_folders_of_sir2_give_one_group_per_shot(tmp_path):
    found = pairing.read_tree(postcard(tmp_path / "p", ["ab", "ba"]), "postcard")
    assert names(found)[:4] == ["ab-Focus-11", "ab-Focus-13", "ab-Focus-16", "ab-Focus-19"]
    assert names(found)[7:10] == ["ab-Thick-3", "ab-Thick-5", "ab-Thick-10"]
    assert {group.scene for group in found.groups} == {"ab", "ba"}
    thick = next(group for group in found.groups if group.name == "ab-Thick-10")
    shot_folder = tmp_path / "p" / "Thick" / "ab" / "10"
    assert (thick.photo, thick.transmission) == (
        shot_folder / "ab-10-m-3.png",
        shot_folder / "ab-10-g-3.png",
    )
    found = pairing.read_tree(solidobject(tmp_path / "s", [2, 10]), "solidobject")
    assert names(found)[::10] == ["2-Focus-11", "10-Focus-11"]
    found = pairing.read_tree(wildscene(tmp_path / "w", 8), "wildscene")
    assert names(found) == ["1s", "2", "3", "4s", "5", "6", "7s", "8"]
    assert all(group.scene == group.name for group in found.groups)
    for group in found.groups:
        assert [path.stem for path in (group.photo, group.transmission, group.reflection)] == [
            "m",
            "g",
            "r",
        ]
        assert len({group.photo.parent, group.transmission.parent, group.reflection.parent}) == 1


def test_two_triplets_in_a_folder_are_distinguished_by_their_names(tmp_path):
    write(tmp_path, *(f"Focus/ab/11/ab-{k}-{letter}-11.png" for k in (3, 5) for letter in "mgr"))
    found = pairing.read_tree(tmp_path, "postcard")
    assert names(found) == ["ab-Focus-11-ab-3-11", "ab-Focus-11-ab-5-11"]
    numbers = [
        [path.name.split("-")[1] for path in (one.photo, one.transmission)] for one in found.groups
    ]
    assert numbers == [["3", "3"], ["5", "5"]]


def test_a_triplet_without_ground_truth_is_excluded_and_one_without_reflection_is_not(tmp_path):
    write(tmp_path, "1/m.jpg", "1/r.jpg", "2/m.jpg", "2/g.jpg", "3/g.jpg", "3/r.jpg")
    found = pairing.read_tree(tmp_path, "wildscene")
    assert names(found) == ["2"]
    assert [line.split(" ")[0] for line in found.excluded] == ["1/m.jpg", "3/g.jpg"]
    assert all("no partner" in line for line in found.excluded)


def test_the_letter_of_a_role_is_a_separate_word_in_either_case(tmp_path):
    files = "1/M.JPG 1/G.JPG 2/img_m.png 2/img_g.png 2/big.png 3/m-g.png 3/grm.png 3/m.png"
    write(tmp_path, *files.split())
    found = pairing.read_tree(tmp_path, "wildscene")
    assert names(found) == ["1", "2"]
    assert found.remarks == ["ignored 2/big.png", "ignored 3/grm.png and 3/m-g.png"]
    assert len(found.excluded) == 1


def test_shots_with_the_same_name_in_two_folders_are_both_excluded(tmp_path):
    kinds = ("Focus", "focus")
    write(tmp_path, *(f"{kind}/ab/11/ab-3-{letter}-11.png" for kind in kinds for letter in "mgr"))
    if len(pairing.list_folder(tmp_path)[0]) < 2:
        pytest.skip("this file system is not case-sensitive")
    found = pairing.read_tree(tmp_path, "postcard")
    assert found.groups == []
    assert len(found.excluded) == 2
    assert all("ambiguous" in line for line in found.excluded)


def test_subsets_are_recognised_by_the_start_of_their_names(tmp_path):
    for name in ("Postcard Dataset", "Solid_Object-2", "WildSceneDataset", "others"):
        (tmp_path / name).mkdir()
    found = [path.name for _, path in sorted(pairing.find_subsets(tmp_path).items())]
    assert found == ["Postcard Dataset", "Solid_Object-2", "WildSceneDataset"]
    (tmp_path / "postcard").mkdir()
    with pytest.raises(
        PhotoError, match=r"two subfolders for postcard, Postcard Dataset and postcard"
    ):
        pairing.find_subsets(tmp_path)


@settings(max_examples=15)
@given(order=st.randoms())
def test_the_order_of_a_listing_does_not_matter(order):
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        pairs = repacked(Path(folder) / "pairs", ["1", "2", "02", "10"])
        write(pairs, "blended/x.png", "gt.txt", "blended/2.jpg")
        tree = postcard(Path(folder) / "tree", ["ab"])

        def read():
            return (
                pairing.read_folders(pairs),
                pairing.read_tree(tree, "postcard"),
                pairing.find_roles(pairs),
            )

        before = read()
        listing = Path.iterdir
        patch.setattr(Path, "iterdir", lambda path: iter(shuffled(listing(path), order)))
        assert read() == before


def shuffled(items, order: random.Random):
    items = list(items)
    order.shuffle(items)
    return items


@given(st.sets(st.text(min_size=1)), st.randoms())
def test_natural_order_is_total_and_puts_2_before_10(texts, order):
    assert sorted(shuffled(texts, order), key=pairing.natural_key) == sorted(
        texts, key=pairing.natural_key
    )
    assert sorted(["a10", "a2", "10", "2", "a"], key=pairing.natural_key) == [
        "2",
        "10",
        "a",
        "a2",
        "a10",
    ]


def test_training_pairs_are_grouped_in_the_same_way_and_have_one_size(tmp_path):
    for size, name in (((8, 6), "2"), ((6, 8), "10")):
        repacked(tmp_path, [name], ("blended", "transmission"), size=size)
    assert [tuple(photo.shape) for photo, _ in read_pairs([tmp_path])] == [(8, 6, 3), (6, 8, 3)]
    write(tmp_path, "transmission/10.jpg")
    with pytest.raises(
        RecipeError, match=r"transmission/10.jpg and transmission/10.png are ambiguous.*"
    ):
        read_pairs([tmp_path])
    write(tmp_path / "other", "blended/a.png")
    write(tmp_path / "other", "gt/a.png", size=(4, 3))
    with pytest.raises(RecipeError, match=r"blended/a.png and .*gt/a.png differ in size; "):
        read_pairs([tmp_path / "other"])
