"""The code base follows its rules: fast imports, typed names, documents whose commands, links and
examples work.
"""

import ast
import inspect
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import huggingface_hub
import jaxtyping
import numpy as np
import pytest
import yaml
from huggingface_hub import errors as hub_errors

import brewster.errors
from brewster.base.image_formats import SUFFIXES
from brewster.cli import cli
from brewster.diffusion.backbones.loading import load_backbone
from brewster.errors import DownloadError
from brewster.separation.tiles import run_tiled
from other_processes import finished

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "brewster"
README = (ROOT / "README.md").read_text()
FILES = sorted(SOURCE.rglob("*.py"))
GENERATED = {"reference", "recipes"}
PAGES = [page for page in sorted(ROOT.glob("docs/*.md")) if page.stem not in GENERATED]
HEAVY_LIBRARIES = {
    "torch",
    "diffusers",
    "transformers",
    "mitsuba",
    "fastapi",
    "ray",
    "onnxruntime",
    "pyvips",
}


def test_array_shapes_are_checked_against_annotations_in_tests():
    """Without the import hook of shape_checks.py, these annotations have no effect."""
    grey = np.zeros((8, 8), np.float32)
    with pytest.raises(jaxtyping.TypeCheckError, match="image"):
        run_tiled(lambda tile: (tile, tile), grey, tile_px=16, overlap_px=2)
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        run_tiled(
            lambda tile: (tile[..., 0],), grey[..., None].repeat(3, 2), tile_px=16, overlap_px=2
        )


@pytest.mark.parametrize(("code", "libraries"), [
    ("import brewster", HEAVY_LIBRARIES),
    ("from brewster.cli import main; main(['--help'])", HEAVY_LIBRARIES),
    ("import brewster.separation", {"torch", "scipy", "PIL", "OpenEXR", "pillow_heif"}),
    ("import brewster.base.download", {"torch", "numpy", "click"}),
    ("import brewster.metrics", {"torch", "scipy", "PIL"}),
    ("import brewster.base.executors.ray_cluster", {"ray"}),
    ("import brewster.render.mitsuba.renderer", {"mitsuba", "drjit"}),
    ("from brewster.options import Options; Options()", {"pydantic"}),
    (("from brewster.cli import main; main(['render', "
     "'--help'])"), {"torch", "pyarrow", "ray", "pyvips"}),
])  # fmt: skip
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
        [
            Path(sys.executable).with_name("mypy"),
            "--strict",
            "--follow-imports=silent",
            "--no-site-packages",  # without the types of numpy, torch and others: 15 s less
            "--ignore-missing-imports",
            "user.py",
        ],
        cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(SOURCE.parent)},
    )
    errors = [
        line.partition("error: ")[2] for line in process.stdout.splitlines() if "error: " in line
    ]
    assert len(errors) == 2, process.stdout
    assert errors[0].startswith('Module has no attribute "Separater"')
    assert errors[1].startswith('Missing positional argument "source"')


FOREIGN_OPTIONS = {"--head", "--multi_gpu"}  # of Ray and of accelerate


def subcommands(command):
    yield command
    for child in getattr(command, "commands", {}).values():
        yield from subcommands(child)


def test_install_lines_need_no_package_index():
    paths = *FILES, *(ROOT / "docs").glob("*.md"), *(ROOT / "runs").glob("*.sh")
    for text in (README, *(path.read_text() for path in paths)):
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
    pages = [*ROOT.glob("docs/**/*.md"), *ROOT.glob("dev/**/*.md")]
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *pages]:
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


def test_advice_names_options_and_commands_that_exist():
    errors = {name for name, value in vars(brewster.errors).items() if inspect.isclass(value)}
    options = {
        name for command in subcommands(cli) for option in command.params for name in option.opts
    }
    advice = [
        (f"{path.name}:{node.lineno}", " ".join(map(ast.unparse, node.args[1:])))
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in errors
    ]
    known = options | FOREIGN_OPTIONS | subcommand_names()
    unknown = {(place, name) for place, text in advice for name in named_in(text) - known}
    assert unknown == set()
    mentioned = {name for _, text in advice for name in named_in(text)}
    assert {"--overwrite", "models install"} <= mentioned  # the search finds both kinds


def subcommand_names():
    """The commands of groups, such as `models list`."""
    groups = {name: getattr(command, "commands", {}) for name, command in cli.commands.items()}
    return {f"{group} {name}" for group, commands in groups.items() for name in commands}


def named_in(text):
    """The options and the commands of groups that a text names."""
    commands = re.findall(r"\bbrewster ((?:models|study|assets) [a-z]+)", text)
    return {*re.findall(r"(?<![\w-])--[a-z]\w[\w-]*", text), *commands}


def test_the_python_versions_of_ci_and_the_version_of_the_citation_are_those_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {kind.rpartition(" ")[2] for kind in project["classifiers"] if ":: 3." in kind}
    (core,) = re.findall(r"python: (\[.*\])", (ROOT / ".github/workflows/check.yml").read_text())
    assert set(yaml.safe_load(core)) == declared
    assert f">={min(declared, key=lambda version: int(version[2:]))}" == project["requires-python"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == project["version"]


def test_the_two_commands_at_the_top_of_install_exist_and_ci_runs_the_same_tests():
    install = README.partition("## Install\n")[2].partition("\n## ")[0]
    (first, *_) = re.findall(r"```\w*\n(.*?)```", install, re.S)
    commands = [line.partition("#")[0].strip() for line in first.splitlines()]
    assert len(commands) == 2
    targets = set(re.findall(r"(?m)^([\w-]+):", (ROOT / "Makefile").read_text()))
    assert {command.removeprefix("make ") for command in commands} <= targets
    ci = (ROOT / ".ci" / "run").read_text()
    assert re.search(rf"(?m)^[^#\n]*{commands[-1]}\b", ci)


def test_the_settings_of_the_mutants_name_existing_files():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mutmut"]
    files = [*settings["only_mutate"], *settings["pytest_add_cli_args_test_selection"]]
    assert [file for file in files if not (ROOT / file).is_file()] == []


@pytest.mark.slow
def test_the_documentation_site_builds_without_warnings_and_requests_nothing_from_other_servers(
    tmp_path,
):
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        tmp_path,
    ]
    process = finished(command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    assert (process.returncode, process.stderr) == (0, "")
    home = (tmp_path / "index.html").read_text("utf-8")
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    assert {page for page in pages if f'href="{page}/"' not in home} == set()
    assert 'src="http' not in home
    assert 'rel="stylesheet" href="http' not in home


PAGE = SOURCE / "web" / "page" / "index.html"


def test_the_page_accepts_every_suffix_of_an_image():
    """The page also sorts the files of a dropped folder by this list."""
    (accepted,) = re.findall(r'accept="image/\*,video/\*,([^"]*)"', PAGE.read_text())
    assert set(accepted.split(",")) == set(SUFFIXES)


def hub_error(error_class, status):
    """An error as huggingface_hub raises it for this status."""
    httpx = sys.modules[hub_errors.Response.__module__.split(".")[0]]
    request = httpx.Request("GET", "https://huggingface.co/api/models/owner/name")
    return error_class(f"{status} Client Error.", response=httpx.Response(status, request=request))


@pytest.mark.parametrize("error", [
    hub_error(hub_errors.GatedRepoError, 403), hub_error(hub_errors.HfHubHTTPError, 503),
    OSError(28, "No space left on device"), hub_errors.LocalEntryNotFoundError("no network"),
    hub_errors.OfflineModeIsEnabled("HF_HUB_OFFLINE"),
])  # fmt: skip
def test_an_error_of_the_hub_is_an_error_of_the_download_that_names_the_model(monkeypatch, error):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
    with pytest.raises(DownloadError, match=r"black-forest-labs/FLUX\.1-Kontext-dev"):
        load_backbone("kontext")


def test_libraries_are_imported_when_a_model_is_built_and_print_nothing(tmp_path):
    code = f"""
import sys
from pathlib import Path
from brewster.diffusion import pipeline
from brewster.diffusion.adapter import lora
from brewster.diffusion.backbones.loading import load_backbone
from brewster.diffusion.backbones.registry import tiny
heavy = {{'diffusers', 'transformers', 'peft', 'safetensors', 'huggingface_hub'}}
assert not heavy & set(sys.modules)
sys.path.insert(0, {str(Path(__file__).parent)!r})
from published_models import save_backbone
save_backbone(tiny('kontext')[0], Path({str(tmp_path)!r}))
load_backbone({str(tmp_path)!r})
"""
    done = finished([sys.executable, "-c", code])
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def run_without_torch(*arguments):
    """Runs the command line in a process in which torch cannot be imported."""
    code = (
        "import sys; sys.modules['torch'] = None; from brewster.cli import main; "
        "sys.exit(main(sys.argv[1:]))"
    )
    return finished([sys.executable, "-c", code, *arguments])


@pytest.mark.parametrize(("command", "name", "line"), [
    ("train", "compact", 'network = "lite2-unet"'), ("train", "lora", 'panels = ["I", "T", "R"]'),
    ("render", "window", "samples_per_pixel ="),
])  # fmt: skip
def test_a_recipe_is_printed_without_torch(command, name, line):
    done = run_without_torch(command, "--show-recipe", name)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"\n{line}" in done.stdout
