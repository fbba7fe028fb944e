"""Parts of first_gpu_day.sh: checks the machine, writes the tiny models and pairs, and writes the
report.

    first_gpu_day.py check DATA OUT                 lists all that is missing; exit code 1
    first_gpu_day.py write-tiny OUT                 writes a tiny WindowSeat, and rendered pairs in
                                                    place of the benchmarks
    first_gpu_day.py report OUT STATUS full|tiny    writes OUT/report.html from the files of the
                                                    other steps
"""

import base64
import csv
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from html import escape
from importlib import metadata
from pathlib import Path

BENCHMARKS = {"real20": "Real 20", "nature20": "Nature 20"}
AGREEMENT_DB = 0.3
"""Papers measure one method with differences of this size, because sizes and rounding differ
(docs/evaluation.md).
"""
GIB = 1 << 30
STYLE = (
    "<style>body{font:16px sans-serif;max-width:90em;margin:2em}td,th{padding:.2em "
    "1em;text-align:left}"
    "pre{background:#eee;padding:1em;overflow:auto}img{height:11em;margin-right:.3em}</style>"
)
ROWS = 4
"""Photos of each benchmark in the report, evenly spread over the names."""


# --- check


def check(data, out):
    """Prints one line for each need that is not met. Nothing is downloaded, and torch is not
    imported.
    """
    missing = [*extras(), *gpu(), *memory_and_disk(Path(out)), *benchmarks(data), *hub()]
    for line in missing:
        print(f"missing: {line}", file=sys.stderr)
    if missing:
        print(f"{len(missing)} needs are not met; nothing was started", file=sys.stderr)
    sys.exit(bool(missing))


def extras():
    command = [
        sys.executable,
        "-m",
        "brewster",
        "doctor",
        "--needs",
        "render,train,diffusion,evaluate",
    ]
    doctor = subprocess.run(command, capture_output=True, text=True, check=False)
    if doctor.returncode:
        yield doctor.stderr.strip().removeprefix("error: ")
    if importlib.util.find_spec("bitsandbytes") is None:
        yield "bitsandbytes, for WindowSeat's 4-bit weights; run: pip install bitsandbytes"
    if importlib.util.find_spec("torch") and metadata.version("torch").endswith("+cpu"):
        yield (
            f"torch with CUDA ({metadata.version('torch')} is installed); install it as "
            "pytorch.org shows"
        )


def gpu():
    query = [
        "nvidia-smi",
        "--query-gpu=name,memory.total,memory.used",
        "--format=csv,noheader,nounits",
    ]
    if not shutil.which(query[0]):
        yield "an NVIDIA GPU with 24 GB (nvidia-smi was not found)"
        return
    listed = subprocess.run(query, capture_output=True, text=True, check=False).stdout.splitlines()
    for name, total, used in (line.split(", ") for line in listed[:1]):
        if int(total) < 23_000:
            yield f"a GPU with 24 GB ({name} has {int(total) / 1024:.0f} GiB)"
        if int(used) > 1_500:
            yield f"a free GPU ({used} MiB of {name} are in use; stop the other programs)"
    if not listed:
        yield "a working NVIDIA driver (nvidia-smi lists no GPU)"


def memory_and_disk(out):
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if memory < 23 * GIB:
        yield f"24 GB of memory (this machine has {memory / GIB:.0f} GiB)"
    cache = Path(os.environ.get("HF_HOME", Path.home() / ".cache" / "huggingface"))
    downloaded = sum(file.stat().st_size for file in cache.glob("hub/models--*/blobs/*"))
    for folder, needed, purpose in (
        (cache, 80 * GIB - downloaded, "models"),
        (out, 8 * GIB, "results"),
    ):
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        if (free := shutil.disk_usage(existing).free) < needed:
            yield (
                f"{needed / GIB:.0f} GiB of disk for {purpose} in {folder} ({free / GIB:.0f} "
                "GiB are free)"
            )


def benchmarks(data):
    if not data:
        yield (
            "BREWSTER_DATA, the folder that contains real20/ and nature20/; run: export "
            "BREWSTER_DATA=/path/to/data"
        )
        return
    for name in BENCHMARKS:
        folder = Path(data) / name / "blended"
        count = len(list(folder.glob("*.*")))
        if count != 20:
            yield f"20 photos in {folder} (found {count}; the layout is in docs/evaluation.md)"


def hub():
    """Asks the hub whether the token may download both models. Their licences must be accepted in a
    browser before.
    """
    if importlib.util.find_spec("huggingface_hub") is None:
        return
    from huggingface_hub import HfApi  # noqa: PLC0415

    for repository in ("black-forest-labs/FLUX.1-Kontext-dev", "Qwen/Qwen-Image-Edit-2509"):
        try:
            HfApi().auth_check(repository)
        except Exception as error:  # noqa: BLE001  (any failure means that the download would fail hours later)
            reason = re.sub(r"\s+", " ", str(error)) or type(error).__name__
            yield (
                f"access to https://huggingface.co/{repository}; "
                f"accept its licence there and run: hf auth login ({reason:.160})"
            )


# --- tiny


def write_tiny(out):
    from published_models import write_qwen_edit_plus, write_windowseat  # noqa: PLC0415  (of tests/)

    model = Path(out) / "windowseat-model"
    if not model.exists():
        write_windowseat(model, write_qwen_edit_plus(Path(out) / "qwen"))
    for seed, name in enumerate(BENCHMARKS, 20):
        folder = Path(out) / "benchmarks" / name
        samples = folder.with_name(f"{name}-samples")
        command = [
            "brewster",
            "render",
            samples,
            "--recipe",
            "tiny",
            "--size",
            "96x72",
            "--seed",
            str(seed),
            "--count",
            "2",
            "--workers",
            "0",
            "--quiet",
        ]
        subprocess.run(command, check=True)
        for layer, subfolder in (("photo", "blended"), ("transmission", "transmission_layer")):
            (folder / subfolder).mkdir(parents=True, exist_ok=True)
            for sample in samples.glob("0*"):
                shutil.copy(sample / f"{layer}.jpg", folder / subfolder / f"{sample.name}.jpg")


# --- report


def report(out, status, kind):
    out = Path(out)
    scores = read_json(out / "evaluate" / "results.json")
    parts = [
        "<!doctype html><meta charset=utf-8><title>brewster: first GPU day</title>",
        STYLE,
        f"<h1>brewster: first GPU day</h1><p>{escape(heading(kind, int(status)))}</p>",
        *verdicts(scores, is_tiny=kind == "tiny"),
        "<h2>Time</h2>", table([("step", ("seconds since the "
                                         "start")), *read_rows(out / "seconds.csv")]),
        *training(out / "lora-run"),
        *pictures(out, scores),
        *(section(title, out / name) for title, name in (
            ("Scores", "evaluate/tables.md"), (("Scores on rendered "
                                               "windows"), "evaluate-rendered/tables.md"),
            ("Machine", "doctor.txt"))),
        f"<pre>{escape(run_output('nvidia-smi'))}</pre>",
        f"<pre>{escape(run_output('git', 'log', '-1', '--oneline'))}</pre>",
        "<h2>End of the log</h2><pre>",
        escape("\n".join(read_text(out / "log.txt").splitlines()[-60:])),
        "</pre>",
    ]  # fmt: skip
    (out / "report.html").write_text("\n".join(parts))
    print(f"the report, one file to send back: {out / 'report.html'}")


def heading(kind, status):
    weights = (
        "Tiny models with random weights: this tests the script, and all scores are meaningless."
        if kind == "tiny"
        else "Real weights."
    )
    failure = f"A step failed with exit code {status}: see the end of the log."
    return f"{weights} {'All steps finished.' if status == 0 else failure}"


def verdicts(scores, *, is_tiny):
    """Yields the table that compares WindowSeat with its published scores."""
    tables = tomllib.loads((Path(__file__).parent / "published.toml").read_text("utf-8"))["table"]
    published = next(
        rows["WindowSeat"] for rows in (each["rows"] for each in tables) if "WindowSeat" in rows
    )
    rows = [("benchmark", "WindowSeat, published", "WindowSeat, here", "difference", "verdict",
             "with guided upsampling", "LoRA", "compact", "input (unprocessed)")]  # fmt: skip
    for name, title in BENCHMARKS.items():
        means = {
            method: columns["psnr"]["mean"]
            for method, columns in scores.get("tables", {}).get(name, {}).items()
            if "psnr" in columns
        }
        expected = float(published[name]["psnr"])
        measured = means.get("WindowSeat")
        rows.append(
            (
                title,
                f"{expected:.2f} dB",
                *compared(measured, expected, is_tiny=is_tiny),
                *(
                    f"{means[method]:.2f} dB" if method in means else "-"
                    for method in ("WindowSeat-guided", "LoRA", "compact", "input (unprocessed)")
                ),
            )
        )
    yield (
        f"<h2>Verdict</h2><p>reproduced: at most {AGREEMENT_DB} dB from the published "
        f"PSNR</p>{table(rows)}"
    )


def compared(measured, expected, *, is_tiny):
    if measured is None:
        return "-", "-", "not measured"
    difference = measured - expected
    verdict = "reproduced" if abs(difference) <= AGREEMENT_DB else "NOT reproduced"
    verdict = "none: a tiny model" if is_tiny else verdict
    return f"{measured:.2f} dB", f"{difference:+.2f} dB", verdict


def training(folder):
    """Yields the loss of the LoRA, as a table, and its sample images."""
    lines = [json.loads(line) for line in read_text(folder / "log.jsonl").splitlines()]
    yield "<h2>Training of the LoRA</h2>"
    if lines:
        last = lines[-1]
        yield f"<p>{last['seconds'] / last['step']:.2f} s per step</p>"
        yield table([list(last), *([f"{value:.5g}" for value in line.values()] for line in lines)])
    if (folder / "samples.png").exists():
        yield image((folder / "samples.png").read_bytes(), "samples.png")


def pictures(out, scores):
    """Yields rows of photo, predictions and ground truth: every n-th photo of each benchmark, not
    the best ones.
    """
    from brewster import Photo  # noqa: PLC0415

    root = Path(os.environ.get("BENCHMARKS", out / "benchmarks"))
    for name, title in BENCHMARKS.items():
        names = [case["name"] for case in scores.get("cases", []) if case["benchmark"] == name]
        step = max(1, len(names) // ROWS)
        yield f"<h2>{title}: photo 1 and every further one at a distance of {step}</h2>"
        yield "<p>photo, WindowSeat, WindowSeat-guided, LoRA, compact, ground truth</p>"
        predictions = out / "evaluate" / "predictions"
        folders = [
            root / name / "blended",
            out / "windowseat" / name,
            *(predictions / method / name for method in ("WindowSeat-guided", "LoRA", "compact")),
            root / name / "transmission_layer",
        ]
        for case in names[::step]:
            files = [next(iter(sorted(folder.glob(f"{case}.*"))), None) for folder in folders]
            yield "<p>" + "".join(
                image(
                    Photo.open(file).thumbnail(360).encode("jpeg", quality=85),
                    f"{case}, {file.parent}",
                )
                for file in files
                if file
            )


def image(data, title):
    media = "png" if data.startswith(b"\x89PNG") else "jpeg"
    return (
        f'<img title="{escape(title)}" '
        f'src="data:image/{media};base64,{base64.b64encode(data).decode()}">'
    )


def table(rows):
    cells = ("".join(f"<td>{escape(str(cell))}" for cell in row) for row in rows)
    return "<table>" + "".join(f"<tr>{row}" for row in cells) + "</table>"


def section(title, path):
    return f"<h2>{title}</h2><pre>{escape(read_text(path))}</pre>"


def read_text(path):
    return path.read_text(errors="replace") if path.exists() else ""


def read_json(path):
    return json.loads(read_text(path) or "{}")


def read_rows(path):
    return list(csv.reader(read_text(path).splitlines()))


def run_output(*command):
    if not shutil.which(command[0]):
        return f"{command[0]}: not found"
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


if __name__ == "__main__":
    {"check": check, "write-tiny": write_tiny, "report": report}[sys.argv[1]](*sys.argv[2:])
