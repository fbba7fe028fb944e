"""The code base follows its rules: import order, fast imports, documented names, a correct README."""

import ast
import inspect
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

import brewster
import brewster.errors
import brewster.inference
import brewster.photo
from brewster.cli import cli
from brewster.inference.tiles import run_tiled
from other_processes import finished

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "brewster"
README = (ROOT / "README.md").read_text()
FILES = sorted(SOURCE.rglob("*.py"))
GENERATED = {"reference", "recipes"}
PAGES = [page for page in sorted(ROOT.glob("docs/*.md")) if page.stem not in GENERATED]
HEAVY_LIBRARIES = {"torch", "diffusers", "transformers", "mitsuba", "fastapi", "ray", "onnxruntime", "pyvips"}


def test_packages_import_only_from_lower_layers():
    process = finished([Path(sys.executable).with_name("lint-imports")], cwd=ROOT)
    assert process.returncode == 0, process.stdout


@pytest.mark.parametrize("command", [["-c", "import brewster"], ["-m", "brewster", "--help"]])
def test_import_and_help_load_no_heavy_library(command):
    process = finished([sys.executable, "-X", "importtime", *command])
    assert process.returncode == 0
    imported = {line.split("|")[-1].strip().split(".")[0] for line in process.stderr.splitlines()}
    assert not imported & HEAVY_LIBRARIES


def test_array_shapes_are_checked_against_annotations_in_tests():
    """Without the import hook of shape_checks.py, these annotations have no effect."""
    grey = np.zeros((8, 8), np.float32)
    with pytest.raises(jaxtyping.TypeCheckError, match="image"):
        run_tiled(lambda tile: (tile, tile), grey, tile_px=16, overlap_px=2)
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        run_tiled(lambda tile: (tile[..., 0],), grey[..., None].repeat(3, 2), tile_px=16, overlap_px=2)


def test_libraries_of_large_models_are_loaded_in_one_package_only():
    """They are imported by name when they are needed, which import-linter cannot see."""
    loaded = {
        (path.relative_to(SOURCE).parts[:2], library)
        for path in FILES
        for library in re.findall(r'\b(?:import_library|diffusers_class)\("?(\w+)', path.read_text())
    }
    other_libraries = {library for package, library in loaded if package != ("models", "diffusion")}
    assert other_libraries == {"accelerate"}  # training/distributed


@pytest.mark.parametrize(
    ("code", "libraries"),
    [
        ("import brewster.inference", {"torch", "scipy", "PIL", "OpenEXR", "pillow_heif"}),
        ("import brewster.download", {"torch", "numpy", "click"}),
        ("import brewster.metrics", {"torch", "scipy", "PIL"}),
        ("import brewster.executors.ray_cluster", {"ray"}),
        ("import brewster.render.mitsuba.renderer", {"mitsuba", "drjit"}),
        ("from brewster.options import Options; Options()", {"pydantic"}),
        ("from brewster.cli import main; main(['render', '--help'])", {"torch", "pyarrow", "ray", "pyvips"}),
    ],
)
def test_a_module_imports_no_library_that_it_may_not_need(code, libraries):
    check = f"import sys; {code}; assert not {libraries} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", check], check=True, capture_output=True)


def test_type_checkers_accept_every_public_name_and_no_other(tmp_path):
    """A module's __getattr__ would make every misspelt name an `object`."""
    (tmp_path / "user.py").write_text("""import brewster
layer: brewster.Photo = brewster.separate("window.jpg", strength=0.5).transmission
separator: brewster.Separator = brewster.Separator.load("compact")
brewster.Separater.load("compact")
brewster.separate()
""")
    process = finished(
        [Path(sys.executable).with_name("mypy"), "--follow-imports=silent", "--strict", "user.py"],
        cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(SOURCE.parent)},
    )
    errors = [line.partition("error: ")[2] for line in process.stdout.splitlines() if "error: " in line]
    assert len(errors) == 2, process.stdout
    assert errors[0].startswith('Module has no attribute "Separater"')
    assert errors[1].startswith('Missing positional argument "source"')


def test_every_public_name_is_exported_and_documented():
    """`__all__` of a package contains all public names that the package defines."""
    for module in (brewster.photo, brewster.inference):
        assert module.__all__ == sorted(module.__all__, key=lambda name: (not name.isupper(), name))
        defined = {
            name
            for name, value in vars(module).items()
            if getattr(value, "__module__", "").startswith("brewster")
        }
        assert {name for name in defined if name[0] != "_"} <= set(module.__all__)
    for name in brewster.__all__:
        value = getattr(brewster, name)
        assert name.startswith("__") or inspect.getdoc(value), name


def test_every_error_is_in_the_tree_of_the_docstring():
    tree = inspect.getdoc(brewster.errors)
    for name, value in vars(brewster.errors).items():
        if inspect.isclass(value):
            assert name in tree


FOREIGN_OPTIONS = {"--head", "--multi_gpu"}  # of Ray and of accelerate


def subcommands(command):
    yield command
    for child in getattr(command, "commands", {}).values():
        yield from subcommands(child)


def test_every_message_has_three_parts_and_names_options_and_commands_that_exist():
    """What happened, what was expected, and what to do. Tests of single errors assert the class and a key part."""
    errors = {name for name, value in vars(brewster.errors).items() if inspect.isclass(value)}
    options = {
        name for command in subcommands(cli) for option in command.params for name in option.opts
    } | FOREIGN_OPTIONS
    raised = [
        (f"{path.name}:{node.lineno}", node.args)
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in errors
    ]
    assert len(raised) > 300
    for place, parts in raised:
        if isinstance(parts[0], ast.Starred):
            continue
        assert len(parts) >= 3, place
        advice = ast.unparse(parts[1]) + ast.unparse(parts[2])
        for option in re.findall(r"(?<![\w-])--[a-z]\w[\w-]*", advice):
            assert option in options, f"{place}: {option}"
        for group, command in re.findall(r"\bbrewster (models|study|assets) ([a-z]+)", advice):
            assert command in cli.commands[group].commands, f"{place}: {command}"


def test_signatures_stay_small():
    for path in (path for path in FILES if path.name != "kernels.py"):  # compiled, with many arrays
        nodes = ast.walk(ast.parse(path.read_text()))
        for node in (node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)):
            positional = [argument.arg for argument in node.args.args if argument.arg not in {"self", "cls"}]
            assert len(positional) <= 5, f"{path}:{node.name}"


def test_the_tree_in_contributing_equals_the_tree_on_disk():
    block = re.search(r"```\n(src/brewster/.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)[1]
    rows = re.findall(r"^  (\S+)", block, re.M)
    listed = {row.rstrip("/") for row in rows}
    on_disk = {
        path.relative_to(SOURCE).with_suffix("").as_posix().split("/")[0]
        for path in FILES
        if not path.name.startswith("__")
    }
    assert listed == on_disk


def test_install_lines_need_no_package_index():
    texts = [
        README,
        *(
            path.read_text()
            for path in (*FILES, *(ROOT / "docs").glob("*.md"), *(ROOT / "runs").glob("*.sh"))
        ),
    ]
    for text in texts:
        assert "OWNER/brewster" not in text
        assert "brewster[" not in text
        for line in re.findall(r"pip install [^`\n]*\.\[.*", text):
            assert "pip install -c constraints.txt -e '.[" in line


def test_the_python_examples_in_the_readme_run(tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", README, re.S)
    assert blocks
    picture = next((ROOT / "tests" / "pictures").glob("mixture*.jpg"))
    (tmp_path / "window.jpg").write_bytes(picture.read_bytes())
    (tmp_path / "holiday").mkdir()
    (tmp_path / "holiday" / "photo.jpg").write_bytes(picture.read_bytes())
    monkeypatch.chdir(tmp_path)
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})


def test_every_link_in_the_documents_has_a_target():
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")]:
        links = re.findall(r"\]\(([^)#]+)", document.read_text())
        for link in (link for link in links if "://" not in link):
            assert (document.parent / link).exists(), f"{document.name}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short_and_its_commands_have_the_options_that_they_use(page):
    text = page.read_text().replace("\\\n", " ")
    assert len(text.split()) <= 1200
    commands = re.findall(r"(?m)^(?:    )?(?:\w+=\S+ )?brewster (.*)", text)
    assert commands or "```python" in text
    for line in commands:
        words = shlex.split(line, comments=True)
        command = cli
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        command = cli.commands["separate"] if command is cli else command
        known = {"--help", "-h"} | {name for option in command.params for name in option.opts}
        used = {word.partition("=")[0] for word in words if re.match("--?[a-z]", word)}
        assert used <= known, line


def test_every_test_file_is_named_after_a_module_or_a_package():
    names = {path.stem for path in FILES} | {path.parent.name for path in FILES} | {"conventions", "report"}
    for path in (ROOT / "tests").glob("test_*.py"):
        words = path.stem.removeprefix("test_").split("_")
        prefixes = {"_".join(words[:count]) for count in range(1, len(words) + 1)}
        assert prefixes & names, path.name


def test_public_class_names_are_unique():
    names = [
        node.name
        for path in FILES
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    assert sorted(set(names)) == sorted(names)
