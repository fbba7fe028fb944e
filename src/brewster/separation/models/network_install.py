"""Installs a published network: downloads its checkpoint, converts it with its authors' code, and
compares both.

    install(PUBLISHED_NETWORKS["rdnet"], status=print)

The authors' code (XReflection) runs in an environment of its own. Until the network is complete,
all files are in `work_folder()`. The same call resumes an interrupted one.
"""

import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from brewster.base.download import Downloader, RemoteFile, output_errors
from brewster.base.files import cache_folder, exclusive_lock, file_digest, free_disk_bytes
from brewster.errors import DeviceError, DownloadError, ModelError
from brewster.separation.models.published_networks import (
    ARCHIVE_URL,
    COMMIT,
    FACTS_FILE,
    PublishedNetwork,
)
from brewster.separation.models.zoo import MODEL_FILE
from brewster.separation.onnx_backend import OnnxBackend

CODE_DIGEST: Final = "10ba7f6c13c113adddf541c4176feea70e0c7adc47bd1f58200d4affee4a2fab"
"""The `code_digest` of XReflection at COMMIT."""
_CONVERTER: Final = Path(__file__).parent / "xreflection" / "converter.py"
_REQUIREMENTS: Final = _CONVERTER.with_name("requirements.txt")
_LIMITS: Final = {"full": 1e-4, "half": 0.015}
"""The largest difference of the layers from XReflection's, in linear light, with full and half
weights, on noise. With random weights, half weights differ by 2e-4 (DSRNet), 1.3e-2 (DSIT) and
9.4e-3 (RDNet). Beyond, full ones are kept.
"""
_CONVERSION_GIB: Final = 6.0
DISK_GIB: Final = 14.0
"""torch with CUDA, which pip may choose, has 6 GiB, a checkpoint with its training state up to 4,
the models 3.
"""
_GIB: Final = 1 << 30
_TRIAL: Final = """
import sys, time
import numpy as np
from brewster import Photo, Separator
pixels = np.random.default_rng(7).integers(0, 256, (3000, 4000, 3), np.uint8)
photo = Photo.from_array(pixels, encoding="srgb")
separator = Separator.load(sys.argv[1])
started = time.perf_counter()
separator(photo)
print(time.perf_counter() - started)
peak_gib = 0
try:
    # Not ru_maxrss, which a process inherits from its parent on Linux.
    with open("/proc/self/status") as file:
        peak_gib = next(int(line.split()[1]) for line in file if line.startswith("VmHWM:")) / 2**20
except (OSError, StopIteration):
    if sys.platform == "darwin":
        import resource
        peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**30
print(peak_gib)
"""


def work_folder() -> Path:
    """Returns the folder of the environment and of unfinished installations."""
    return cache_folder() / "models" / "installing"


def install(
    network: PublishedNetwork,
    *,
    checkpoint: Path | None = None,
    status: Callable[[str], None] = print,
    on_bytes: Callable[[int, int], None] = lambda _received, _size: None,
) -> None:
    """Installs a network into its folder.

    `checkpoint`, the file of the publishers, is downloaded by default. `status` is called with a
    line about each step, `on_bytes` with the received bytes and the size of the checkpoint.

    Raises:
        DeviceError: the machine has too little memory.
        DownloadError: there is no connection, or the disk is too small.
        ModelError: the checkpoint or the code is wrong, or the conversion failed, or differs from
            the authors' code.
        OutputError: the cache cannot be written, or another installation runs.
    """
    _check_machine(network)
    work = work_folder()
    again = "delete it, and run the same command again"
    out = work / network.name
    path = checkpoint or work / f"{network.name}.ckpt"
    if checkpoint:  # before anything is downloaded
        _check_checkpoint(network, checkpoint)
    with exclusive_lock(work), output_errors(work):
        code = _downloaded_code(work, status)
        if code_digest(code) != CODE_DIGEST:
            happened = f"{code} is another version of XReflection"
            raise ModelError(happened, f"expected its Python files at commit {COMMIT}", again)
        if not path.exists() and not checkpoint:
            size = Downloader().size(network.url)
            status(f"downloading {network.url} ({size / 1e6:,.0f} MB)")
            downloader = Downloader(on_bytes=lambda received: on_bytes(received, size))
            downloader.fetch(RemoteFile(network.url, size, "sha256", ""), path)
        digest = file_digest(path, "sha256")
        stamp = path.with_suffix(".sha256")
        if not checkpoint:
            _check_checkpoint(network, path)
            if stamp.exists() and stamp.read_text() != digest:
                happened = f"{path} has another SHA-256 than when it was downloaded"
                raise ModelError(happened, f"expected {stamp.read_text()}", again)
            stamp.write_text(digest)
        python = _environment(work, status)
        status(f"converting {network.kind}, which takes several minutes")
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        # -I: modules of this Python, for example in PYTHONPATH, must not replace those of the
        # environment
        _run(python, "-I", _CONVERTER, code.resolve(), path.resolve(), network.kind, out)
        facts = {"checkpoint_sha256": digest, **_compared(out, status)}
        is_half = facts["largest_difference_half"] <= _LIMITS["half"]
        kept, unused = ("half", "full") if is_half else ("full", "half")
        (out / f"{kept}.onnx").replace(out / MODEL_FILE)
        for name in (f"{unused}.onnx", "reference.npz"):
            (out / name).unlink()
        facts["sha256"] = file_digest(out / MODEL_FILE, "sha256")
        _write_facts(network, out, facts)
        shutil.rmtree(network.folder, ignore_errors=True)
        out.replace(network.folder)
        status("measuring a photo of 12 megapixels")
        seconds, peak = map(float, _run(Path(sys.executable), "-c", _TRIAL, network.name).split())
        facts |= {"seconds": round(seconds, 1), "memory_gib": round(peak, 2) or None}
        _write_facts(network, network.folder, facts)
        status(f"{network.name}: {seconds:.0f} s, {peak:.1f} GiB for a photo of 12 megapixels")


def clean(names: Sequence[str]) -> None:
    """Removes the downloads of these networks, and all else if there are no unfinished downloads of
    others.
    """
    work = work_folder()
    for name in names:
        for path in work.glob(f"{name}.*"):
            path.unlink()
    if not any(work.glob("*.ckpt*")):
        shutil.rmtree(work)


def code_digest(folder: Path) -> str:
    """Returns the SHA-256 of XReflection's Python files and their names, with the line ends of
    Linux.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.glob("xreflection/**/*.py")):
        digest.update(f"{path.relative_to(folder).as_posix()}\n".encode())
        digest.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()


def _check_machine(network: PublishedNetwork) -> None:
    needed = max(network.memory_gib, _CONVERSION_GIB)
    if hasattr(os, "sysconf"):  # not on Windows
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / _GIB
        if total < 0.9 * needed:  # some of it is reserved for the hardware
            happened = f"this machine has {total:.1f} GiB of memory"
            raise DeviceError(
                happened, f"expected {needed:g} GiB for {network.kind}", "choose another network"
            )
    if not work_folder().exists() and (free := free_disk_bytes(work_folder()) / _GIB) < DISK_GIB:
        raise DownloadError(
            f"the disk of {work_folder()} has {free:.1f} GiB of free space",
            f"expected {DISK_GIB:g} GiB for the conversion; {network.model_mb / 1000:.1f} GB "
            "stay in use",
            "free some space, or set XDG_CACHE_HOME to a folder on another disk",
        )


def _check_checkpoint(network: PublishedNetwork, path: Path) -> None:
    """Checks without torch that the file is complete and of this network: a zip file with the names
    of the weights.
    """
    try:
        with zipfile.ZipFile(path) as file:
            names = file.read(next(name for name in file.namelist() if name.endswith("data.pkl")))
    except (OSError, StopIteration, zipfile.BadZipFile) as error:
        happened = f"{path} is no complete checkpoint ({error or 'it has no weights'})"
        cure = "delete it or name another one; without --checkpoint, it is downloaded"
        raise ModelError(happened, f"expected the file {network.url}", cure) from error
    if network.marker.encode() not in names:
        happened = f"{path} is a checkpoint of another network"
        expected = f"expected weights {network.marker}*, as in {network.url}"
        raise ModelError(happened, expected, "give the file of this network")


def _downloaded_code(work: Path, status: Callable[[str], None]) -> Path:
    folder = work / f"XReflection-{COMMIT}"
    if not folder.exists():
        status(f"downloading {ARCHIVE_URL}")
        with zipfile.ZipFile(io.BytesIO(Downloader().read(ARCHIVE_URL))) as archive:
            archive.extractall(work / "archive")
        (work / "archive" / folder.name).replace(folder)
    return folder


def _environment(work: Path, status: Callable[[str], None]) -> Path:
    """Returns the interpreter of the environment, which is created if it is not complete."""
    folder = work / "environment"
    requirements = _REQUIREMENTS.read_text()
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    stamp = folder / "installed.txt"
    if not stamp.exists() or stamp.read_text() != requirements:
        status(f"installing torch and {requirements.count('==') - 1} other packages into {folder}")
        _run(Path(sys.executable), "-m", "venv", folder)
        # Wheels only: a package without one would need a compiler, and fail late
        _run(
            python, "-m", "pip", "install", "--quiet", "--only-binary", ":all:", "-r", _REQUIREMENTS
        )
        stamp.write_text(requirements)
    return python


def _run(program: Path, *arguments: str | Path) -> str:
    """Runs a program, and returns its output. Raises ModelError with the last line of its messages
    if it fails.
    """
    command = [str(program), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if result.returncode:
        lines = [line.strip() for line in result.stderr.splitlines() if line.strip()]
        reason = (
            lines[-1][:400]
            if lines and result.returncode > 0
            else "it was killed; perhaps memory is short"
        )
        raise ModelError(
            f"{program.name} {' '.join(command[1:3])} failed: {reason}",
            "expected no error",
            "remove the cause, and run the same command again to resume",
        )
    return result.stdout


def _compared(out: Path, status: Callable[[str], None]) -> dict[str, Any]:
    """Compares the models with the reference at two sizes. Raises ModelError if full weights exceed
    their limit.
    """
    differences = dict[str, Any]()
    with np.load(out / "reference.npz") as reference:
        for name, limit in _LIMITS.items():
            backend = OnnxBackend(out / f"{name}.onnx", "cpu", is_large=True)
            errors = []
            for index in (0, 1):
                photo, *expected = (
                    reference[f"{kind}{index}"][0].transpose(1, 2, 0) for kind in "ITR"
                )
                pairs = zip(backend(photo), expected, strict=True)
                errors.append(max(float(np.abs(layer - same).max()) for layer, same in pairs))
                size = f"{photo.shape[1]} x {photo.shape[0]}"
                status(
                    f"{name} weights, {size}: largest difference {errors[-1]:.1e} (limit {limit:g})"
                )
            if name == "full" and not max(errors) <= limit:
                happened = f"the converted network differs from XReflection's by {max(errors):.1e}"
                raise ModelError(happened, f"expected at most {limit:g}", "please report this")
            differences[f"largest_difference_{name}"] = max(errors)
    return differences


def _write_facts(network: PublishedNetwork, folder: Path, facts: dict[str, Any]) -> None:
    (folder / FACTS_FILE).write_text(json.dumps(facts, indent=1))
    (folder / MODEL_FILE).with_suffix(".md").write_text(network.card(facts))
