"""`brewster doctor`: checks what works on this machine, what is missing, and which command installs
it.
"""

import importlib
import json
import platform
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Final, Literal, final

import click

from brewster.cli.extras import CORE, EXTRAS, missing_packages, module_of
from brewster.cli.parameters import JSON
from brewster.cli.terminal import print_out
from brewster.errors import MissingExtra, install_command

_ALTERNATIVES: Final = {
    "onnxruntime": ("onnxruntime-gpu", "onnxruntime-rocm", "onnxruntime-directml")
}
"""Required package -> packages that install the same module."""
_SYMBOLS: Final = {"ok": "ok", "missing": "--", "broken": "!!"}


@final
@dataclass(frozen=True)
class Check:
    """The result of one check, printed as one line."""

    area: str
    name: str
    status: Literal["ok", "missing", "broken"]
    detail: str
    cure: str | None = None
    """The command or action that repairs the part, if it does not work."""
    needed: bool = True
    """Whether the part is required. If an optional part does not work, the exit code is still 0."""


@click.command
@JSON
@click.option(
    "--needs",
    metavar="EXTRA,...",
    help="Only check that these extras are installed, and print one command that installs all of "
    "them.",
)
@click.pass_context
def doctor(context: click.Context, *, as_json: bool, needs: str | None) -> None:
    """Check what works on this machine and what is missing.

    The command that installs a missing part is printed below it. Commands with constraints.txt must
    be run in the root of the repository of brewster. The exit code is 1 if a required part does not
    work.
    """
    if needs is not None:
        _require_extras(needs.split(","))
        return
    checks = list(run_checks())
    is_healthy = all(check.status == "ok" for check in checks if check.needed)
    if as_json:
        print_out(json.dumps({"ok": is_healthy, "checks": [asdict(check) for check in checks]}))
    else:
        for area, found in groupby(checks, key=lambda check: check.area):
            print_out(area)
            for check in found:
                cure = f"\n{'':8}{check.cure}" if check.cure else ""
                print_out(f"  {_SYMBOLS[check.status]}  {check.name:16} {check.detail}{cure}")
        problem = "A required part does not work: see the lines with !! and -- above."
        print_out("All required parts work." if is_healthy else problem)
    context.exit(0 if is_healthy else 1)


def _require_extras(names: list[str]) -> None:
    if unknown := [name for name in names if name not in EXTRAS]:
        raise click.BadParameter(
            f"there is no extra {unknown[0]!r}; expected some of {', '.join(EXTRAS)}."
        )
    if missing := missing_packages(
        dict.fromkeys(package for name in names for package in EXTRAS[name])
    ):
        raise MissingExtra.for_extra(
            ",".join(names),
            f"not installed: {', '.join(missing)}",
            f"expected the extras {', '.join(names)}",
        )


def run_checks() -> Iterator[Check]:
    """Runs all checks, and yields their results. Each part is checked after the parts that it
    depends on.
    """
    # pip installs brewster only for a Python that it supports
    yield Check("python", "python", "ok", f"{platform.python_version()}, {platform.platform()}")
    yield from _packages()
    yield from _devices()


def _packages() -> Iterator[Check]:
    yield from map(_package, CORE)
    for extra, packages in EXTRAS.items():
        versions = {package: _version(package) for package in packages}
        missing = [package for package, version in versions.items() if version is None]
        found = ", ".join(
            f"{package} {version}" for package, version in versions.items() if version
        )
        detail = f"without {', '.join(missing)}" if missing else found
        cure = install_command(extra) if missing else None
        yield Check("extras", extra, "missing" if missing else "ok", detail, cure, needed=False)


def _package(package: str) -> Check:
    installed = [name for name in (*_ALTERNATIVES.get(package, ()), package) if _version(name)]
    if not installed:
        return Check("packages", package, "missing", "not installed", f"pip install {package}")
    version = f"{_version(installed[0])}" + (
        "" if installed[0] == package else f" ({installed[0]})"
    )
    try:
        importlib.import_module(module_of(package))
    except (
        ImportError,
        OSError,
    ) as error:  # a shared library is missing, or was built for another machine
        cure = f"pip install {installed[0]} --force-reinstall"
        return Check("packages", package, "broken", f"{version}: {error}", cure)
    return Check("packages", package, "ok", version)


def _version(package: str) -> str | None:
    from importlib import metadata  # noqa: PLC0415  (slow to import)

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _devices() -> Iterator[Check]:
    try:
        from brewster.separation.onnx_backend import available_devices  # noqa: PLC0415  (imports ONNX Runtime)

        devices = available_devices()
    except (ImportError, OSError) as error:
        yield Check("devices", "devices", "broken", str(error), "repair the packages above")
        return
    if "cuda" not in devices and shutil.which("nvidia-smi"):
        detail = "an NVIDIA driver is installed, but the package onnxruntime does not support CUDA"
        yield Check(
            "devices", "cuda", "missing", detail, "pip install onnxruntime-gpu", needed=False
        )
    for device in devices:
        yield Check(
            "devices", device, "ok", "used by --device auto" if device == devices[0] else ""
        )
