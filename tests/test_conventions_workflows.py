"""CI workflows and documents for contributors are up to date: paths, make targets, versions."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


def commands(workflow):
    jobs = yaml.safe_load(workflow.read_text())["jobs"].values()
    return "\n".join(step.get("run", "") for job in jobs for step in job["steps"])


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_every_file_in_a_workflow_exists(workflow):
    files = re.findall(r"(?:tests|runs|\.ci)/[\w/*.]+|[\w.]+\.(?:txt|toml)", commands(workflow))
    assert files
    for name in files:
        assert list(ROOT.glob(name)), name


def test_ci_runs_every_python_version_of_the_package():
    declared = {kind.rpartition(" ")[2] for kind in PROJECT["classifiers"] if ":: 3." in kind}
    (core,) = re.findall(r"python: (\[.*\])", (ROOT / ".github/workflows/check.yml").read_text())
    assert set(yaml.safe_load(core)) == declared
    assert min(declared, key=lambda version: int(version[2:])) == PROJECT["requires-python"].removeprefix(
        ">="
    )


def test_ci_runs_the_checks_and_the_tests():
    assert ".ci/run" in commands(ROOT / ".github/workflows/check.yml")
    assert {"make check", "make test"} <= set((ROOT / ".ci/run").read_text().splitlines())


def test_citation_and_changelog_have_the_version_of_the_package():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == PROJECT["version"]
    assert f"\n## [{PROJECT['version']}] - 20" in (ROOT / "CHANGELOG.md").read_text()
