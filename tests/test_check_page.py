"""The check of the pages' JavaScript and CSS: .ci/check_page."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = [path for kind in ("js", "css") for path in ROOT.glob(f"src/**/*.{kind}")]
SHELL_PROGRAMS = ("bash", "dirname", "sed")


@pytest.fixture
def checkout(tmp_path):
    """A copy of what the check reads, with a script that breaks its rules, and without Biome."""
    (tmp_path / ".ci").mkdir()
    for name in (".ci/check_page", "package.json", "biome.json"):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "page.js").write_text("var  count = 1\nif (count == 1) count = 2")
    return tmp_path


def run_check(checkout, **programs):
    """Runs the check where only a shell and these programs are installed, scripts by name."""
    folder = checkout / "bin"
    folder.mkdir()
    for name in SHELL_PROGRAMS:
        (folder / name).symlink_to(shutil.which(name))
    for name, script in programs.items():
        program = folder / name
        program.write_text(f"#!{shutil.which('bash')}\n{script}\n")
        program.chmod(0o755)
    return subprocess.run(
        [shutil.which("bash"), checkout / ".ci/check_page"],
        env={"PATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_scripts_and_styles_of_the_pages_have_lines_of_at_most_100_columns():
    assert len(SOURCES) > 15
    long = [
        f"{path.name}:{number}"
        for path in SOURCES
        for number, line in enumerate(path.read_text("utf-8").split("\n"), 1)
        if len(line) > 100
    ]
    assert long == []


def test_the_check_of_the_pages_passes_with_a_message_where_node_is_missing(checkout):
    finished = run_check(checkout)
    assert finished.returncode == 0
    assert "not checked" in finished.stderr


def test_the_check_of_the_pages_passes_with_a_message_where_packages_cannot_be_installed(checkout):
    finished = run_check(checkout, node="exit 0", npm="exit 1")
    assert finished.returncode == 0
    assert "not checked" in finished.stderr


def test_the_check_of_the_pages_fails_if_biome_finds_a_fault(checkout):
    biome = ROOT / "node_modules"
    if not biome.exists():
        pytest.skip("no Biome; run: make check")
    (checkout / "node_modules").symlink_to(biome)
    finished = subprocess.run([checkout / ".ci/check_page"], capture_output=True, check=False)
    assert finished.returncode != 0
