"""Benchmarks are read completely, in either layout. Cases that do not fit are excluded."""

import pickle

import pytest

from benchmark_folders import POSTCARD_SCENES, picture, postcard, repacked, sir2, wildscene, write
from brewster.base.files import natural_key
from brewster.errors import PhotoError
from brewster.evaluation.benchmarks import registry
from brewster.evaluation.benchmarks.image_files import Case, ImageFile
from brewster.photo import Photo
from picture_files import exif_block, file_of, smooth
from set_folders import render_set


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return sir2(tmp_path_factory.mktemp("benchmarks") / "SIR2")


@pytest.fixture(scope="module")
def subsets(original):
    return {benchmark.name: benchmark for benchmark in registry.read_benchmark("sir2", original)}


def only(name, folder) -> registry.Benchmark:
    (benchmark,) = registry.read_benchmark(name, folder)
    return benchmark


def names(cases):
    return [case.name for case in cases]


@pytest.mark.parametrize("name", ["real20", "nature20"])
def test_twenty_pairs_are_read_under_the_name_of_their_benchmark(tmp_path, name):
    read = only(name, repacked(tmp_path, map(str, range(20, 0, -1))))
    assert (read.name, read.title.lower(), read.expected_counts) == (name, name, (20,))
    assert names(read.cases) == [str(number) for number in range(1, 21)]
    assert read.remarks == read.excluded == ()
    photo, truth = (
        ImageFile(tmp_path / role / "2.png") for role in ("blended", "transmission_layer")
    )
    assert read.cases[1] == Case(name, "2", "2", "blended/2", photo, truth)


def test_the_original_sir2_has_199_and_200_and_101_triplets(subsets):
    counts = {name: len(read.cases) for name, read in subsets.items()}
    assert counts == {"postcard": 199, "solidobject": 200, "wildscene": 101}
    for name, read in subsets.items():
        assert read.remarks == read.excluded == ()
        assert all(case.reflection for case in read.cases)
        assert {case.benchmark for case in read.cases} == {name}
        assert len({case.relative_path for case in read.cases}) == len(read.cases)
        assert len(set(names(read.cases))) == len(read.cases)
        assert len({case.scene for case in read.cases}) == (101 if name == "wildscene" else 20)


def test_a_relative_path_is_that_of_the_photo_below_the_benchmark_folder(subsets, original):
    paths = {case.name: case.relative_path for read in subsets.values() for case in read.cases}
    assert paths["ab-Thick-10"] == "Postcard Dataset/Thick/ab/10/ab-10-m-3"
    assert paths["1-Focus-11"] == "SolidObjectDataset/1/Focus/11/m"
    assert paths["7s"] == "Wildscene/7s/m"
    alone = only("solidobject", original / "SolidObjectDataset")
    assert alone.cases[0].relative_path == "1/Focus/11/m"


@pytest.mark.parametrize("subset", ["postcard", "solidobject", "wildscene"])
def test_a_subset_of_sir2_is_read_from_its_own_folder_and_from_the_parent_folder(
    subsets, original, subset
):
    above = only(subset, original)
    alone = only(subset, above.cases[0].photo.path.parents[1 if subset == "wildscene" else 3])
    assert above == subsets[subset]
    read = ([(case.name, case.scene, case.photo) for case in part.cases] for part in (alone, above))
    assert next(read) == next(read)


def test_a_part_of_sir2_can_be_repacked_and_missing_subsets_are_reported(tmp_path):
    repacked(tmp_path / "postcard", ["ab-3-32", "ab-5-32", "ba-1-2"])
    wildscene(tmp_path / "WildSceneDataset", 55)
    cards, wild = registry.read_benchmark("sir2", tmp_path)
    assert names(cards.cases) == ["ab-3-32", "ab-5-32", "ba-1-2"]
    assert [case.scene for case in cards.cases] == ["ab", "ab", "ba"]
    assert cards.cases[0].relative_path == "postcard/blended/ab-3-32"
    assert cards.remarks == (
        f"SIR2 SolidObject is not in {tmp_path}",
        "found 3 images, expected 199",
    )
    assert (len(wild.cases), wild.remarks) == (55, ())


def test_the_only_split_below_an_openrr_folder_is_read(tmp_path):
    repacked(tmp_path / "val_100", ["1", "2"], ("Input", "GT"))
    read = only("openrr", tmp_path)
    assert (read.name, read.expected_counts, read.remarks) == ("openrr", (), ())
    assert read.cases[0].relative_path == "val_100/Input/1"
    assert names(only("openrr", tmp_path / "val_100").cases) == ["1", "2"]


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("my window", "my-window"), ("..odd/", "odd"), ("写真", "pairs"), ("v1.0_b", "v1.0_b"),
        ("real20", "pairs-real20"), ("average", "pairs-average"), ("pairs", "pairs"),
    ],
)  # fmt: skip
def test_a_folder_of_pairs_has_its_name_but_never_that_of_a_known_benchmark(tmp_path, folder, name):
    read = only("pairs", repacked(tmp_path / folder, ["a"]))
    assert (read.name, read.title) == (name, folder.rstrip("/"))
    assert read.cases[0].benchmark == name


def test_a_folder_with_sets_gives_one_benchmark_for_each_set(tmp_path):
    for name in ("nature", "real"):
        repacked(tmp_path / "all" / name, ["a"])
    (tmp_path / "all" / "notes").mkdir()
    read = registry.read_benchmark("pairs", tmp_path / "all")
    assert (
        [part.name for part in read]
        == [part.cases[0].benchmark for part in read]
        == ["nature", "real"]
    )


def test_as_many_parent_folders_are_added_as_are_needed(tmp_path, monkeypatch):
    folders = [repacked(tmp_path / parent / "a" / "test", ["1"]) for parent in ("x", "y")]
    read = [only("pairs", folder) for folder in folders]
    both = list(zip(read, folders, strict=True))
    assert [part.name for part in registry.with_unique_names(both)] == ["x-a-test", "y-a-test"]
    monkeypatch.chdir(folders[0])
    assert only("pairs", registry.Path()).name == "test"
    relative = registry.with_unique_names([(read[0], registry.Path()), both[1]])
    assert [part.name for part in relative] == ["x-a-test", "y-a-test"]
    equal = {part.name for part in registry.with_unique_names([both[0], both[0]])}
    assert len(equal) == 1


@pytest.mark.parametrize("shards", [False, True])
def test_a_rendered_set_gives_its_background_and_its_reflection(tmp_path, shards):
    render_set(tmp_path / "set", count=3, shards=shards)
    read = only("rendered", tmp_path / "set")
    assert (read.name, read.title, read.remarks, read.excluded) == ("set", "set", (), ())
    assert names(read.cases) == ["000000", "000001", "000002"]
    for case in read.cases:
        assert case.rendered
        assert (case.scene, case.relative_path) == (case.name, f"{case.name}/photo")
        assert Photo.open(case.photo.read()).size == (24, 16)
    render_set(tmp_path / "again", count=3)
    for case in read.cases:
        folder = tmp_path / "again" / case.name
        assert case.ground_truth.read() == (folder / "background.jpg").read_bytes()
        assert case.reflection.read() == (folder / "reflection.jpg").read_bytes()


def test_an_incomplete_rendered_sample_is_excluded(tmp_path):
    render_set(tmp_path, count=2)
    (tmp_path / "000001" / "background.jpg").unlink()
    read = only("rendered", tmp_path)
    assert names(read.cases) == ["000000"]
    assert read.excluded == (
        "000001 is incomplete: expected photo.jpg, background.jpg, reflection.jpg",
    )


@pytest.mark.parametrize(("size", "message"), [
    ((420, 279), "the photo is 1200x800, the ground truth is 420x279"),
    ((800, 1200), "the photo is 1200x800, the ground truth is 800x1200: one of them is rotated"),
    ((1199, 800), "the photo is 1200x800, the ground truth is 1199x800: expected equal sizes"),
])  # fmt: skip
def test_a_ground_truth_of_another_size_is_excluded_and_its_scale_is_reported(
    tmp_path, size, message
):
    write(tmp_path, "blended/a.png", size=(1200, 800))
    write(tmp_path, "gt/a.png", size=size)
    read = only("pairs", tmp_path)
    assert read.cases == ()
    (reason,) = read.excluded
    assert reason.startswith(f"blended/a: {message}")


def test_sizes_are_compared_after_the_exif_orientation(tmp_path):
    write(
        tmp_path,
        "blended/a.jpg",
        data=file_of(smooth(6, 8), "JPEG", exif=exif_block(orientation=6)),
    )
    write(tmp_path, "gt/a.png", size=(6, 8))
    assert names(only("pairs", tmp_path).cases) == ["a"]


@pytest.mark.parametrize(
    ("role", "label"),
    [
        ("blended", "photo"),
        ("transmission_layer", "ground truth"),
        ("reflection_layer", "reflection"),
    ],
)
@pytest.mark.parametrize(
    ("bad", "why"), [(b"", "is empty"), (b"no picture", "no known image format")]
)
def test_an_unreadable_image_is_excluded_and_named(tmp_path, role, label, bad, why):
    repacked(tmp_path, ["a", "b"], ("blended", "transmission_layer", "reflection_layer"))
    (tmp_path / role / "a.png").write_bytes(bad)
    read = only("pairs", tmp_path)
    assert names(read.cases) == ["b"]
    assert read.excluded[0].startswith(f"blended/a: the {label} cannot be read: ")
    assert why in read.excluded[0]


def test_a_file_or_a_span_of_it_is_read_and_can_be_pickled(tmp_path):
    write(tmp_path, "a.png")
    whole = ImageFile(tmp_path / "a.png")
    span = ImageFile(tmp_path / "a.png", (1, 3))
    assert whole.read() == picture()
    assert span.read() == b"PNG"
    assert pickle.loads(pickle.dumps(span)) == span


def test_the_subset_of_the_paper_has_one_shot_of_each_scene(subsets):
    for name in ("postcard", "solidobject"):
        drawn = registry.paper_subset(subsets[name])
        assert len(drawn) == len({case.scene for case in drawn}) == 20
        assert set(drawn) <= set(subsets[name].cases)
        assert [case.scene for case in drawn] == sorted(
            (case.scene for case in drawn), key=natural_key
        )
        assert drawn != registry.paper_subset(subsets[name], seed=registry.PAPER_SEED + 1)
    assert registry.paper_subset(subsets["wildscene"]) == subsets["wildscene"].cases


def test_the_published_subset_never_changes(subsets):
    solid = {case.scene: case.name for case in registry.paper_subset(subsets["solidobject"])}
    assert " ".join(solid[str(scene)].split("-", 1)[1] for scene in range(1, 11)) == (
        "Focus-16 Focus-19 Focus-11 Focus-11 Thick-10 Thick-10 Focus-22 Focus-11 Focus-32 Thick-3"
    )


def test_the_drawn_case_of_a_scene_depends_on_no_other_scene(subsets, tmp_path):
    full = {case.scene: case.name for case in registry.paper_subset(subsets["postcard"])}
    few = registry.paper_subset(only("postcard", postcard(tmp_path, POSTCARD_SCENES[3:6])))
    assert {case.scene: case.name for case in few} == {
        scene: full[scene] for scene in POSTCARD_SCENES[3:6]
    }


def test_a_repacked_set_whose_names_identify_the_scenes_has_a_subset(tmp_path):
    read = only(
        "solidobject", repacked(tmp_path, ["1-Focus-11", "1-Focus-13", "12_Thick_3", "2-x"])
    )
    assert [case.scene for case in read.cases] == ["1", "1", "2", "12"]
    assert [case.scene for case in registry.paper_subset(read)] == ["1", "2", "12"]


@pytest.mark.parametrize(
    "stems", [["ab-1", "7"], ["1", "2"], [f"{number}-m" for number in range(21)]]
)
@pytest.mark.parametrize("name", ["postcard", "solidobject"])
def test_a_repacked_set_whose_names_do_not_identify_the_scenes_has_no_subset(tmp_path, name, stems):
    read = only(name, repacked(tmp_path, stems))
    assert [case.scene for case in read.cases] == names(read.cases)
    assert any(
        remark.startswith("the file names do not identify the scenes") for remark in read.remarks
    )
    with pytest.raises(PhotoError, match=r"do not identify the scenes of SIR2 .*; .*; .*"):
        registry.paper_subset(read)


def test_the_subset_of_other_benchmarks_is_the_whole_benchmark(tmp_path):
    for name, folder in (("real20", "r"), ("pairs", "mine"), ("pairs", "postcard")):
        read = only(name, repacked(tmp_path / folder, ["a", "b"]))
        assert registry.paper_subset(read) == read.cases
