"""`brewster models`: list models, print their cards, verify their files, and import a LoRA."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from brewster.base.files import write_atomically
from brewster.cli.extras import require_extra
from brewster.cli.parameters import FILE, JSON, Number, flag
from brewster.cli.terminal import print_error, print_out, print_status, progress
from brewster.diffusion.memory import BACKBONE_COSTS
from brewster.diffusion.models import LIST_GPU_GIB
from brewster.errors import ModelError, read_errors
from brewster.separation import registry
from brewster.separation.models import zoo
from brewster.separation.models.published_networks import PUBLISHED_NETWORKS, REPOSITORY

if TYPE_CHECKING:
    from brewster.diffusion.task import Panel

_NAME = click.argument("name", default="compact")
_CARD_FILE = "README.md"


@click.group
def models() -> None:
    """List, install, import and verify models."""


@models.command("list")
@JSON
def list_models(*, as_json: bool) -> None:
    """List the models of brewster, installed and not, and diffusion models that are downloaded at
    first use.

    An entry has the name, the size of the file or download, and the licence; a published network
    also its time and memory, its published score, and whether it is installed; a diffusion model
    its layers, its GPU memory (with the format of the weights, and with the weights offloaded), the
    download of its text encoder, and how to get it. Sizes and memory of diffusion models are
    estimates for a GPU with 24 GiB.
    """
    rows = []
    errors = [*registry.broken_packages()]
    if not as_json:
        print_out(f"{'name':20} {'size':>10}  licence; time and memory, score, and how to get it")
    for model in registry.registered().values():
        origin = {"package": model.package} if model.package else {}
        try:
            with registry.plugin_errors(model.package):
                rows.append(model.describe() | origin)
                size, (first, *lines) = model.listing(rows[-1])
        except ModelError as error:
            errors.append(error)
            continue
        if not as_json:
            print_out(f"{model.name:20} {size:>10}  {first}")
            for line in (*lines, *(f"from the package {name}" for name in origin.values())):
                print_out(f"{'':33}{line}")
    if as_json:
        print_out(json.dumps(rows))
    for problem in errors:
        print_error(str(problem))
    if not as_json:
        print_status(f"memory: estimates for a GPU with {LIST_GPU_GIB} GiB")


_NETWORKS = click.argument(
    "names", nargs=-1, required=True, type=click.Choice([*PUBLISHED_NETWORKS])
)


@models.command
@_NETWORKS
@flag("--yes", help="Do not ask.")
@click.option(
    "--checkpoint",
    metavar="FILE",
    type=FILE,
    help="The checkpoint of the publishers, if it is on this machine.",
)
def install(*, names: tuple[str, ...], yes: bool, checkpoint: Path | None) -> None:
    """Download published networks and convert them to ONNX: dsrnet, rdnet, dsit.

    Prints the source, the size and the licence, and asks once. The code of the authors,
    XReflection, and torch are installed into a temporary environment. Each network is compared with
    the code of its authors, and measured on this machine. The same command resumes an interrupted
    installation.
    """
    from brewster.separation.models.network_install import DISK_GIB, clean, install, work_folder  # noqa: PLC0415

    if checkpoint and len(names) > 1:
        raise click.UsageError("--checkpoint is for one network.")
    for network in (PUBLISHED_NETWORKS[name] for name in names):
        cost = (
            f"{network.model_mb} MB, {network.memory_gib:g} GiB memory, "
            f"{network.seconds_per_photo()[0]:.0f} s/photo"
        )
        print_status(
            f"{network.name}: {checkpoint or network.url}, converted {cost}; licence: "
            f"{network.licence}"
        )
    print_status(
        f"with the code {REPOSITORY} and torch, all in {work_folder()} until then: up to "
        f"{DISK_GIB:g} GiB"
    )
    if not yes:
        click.confirm("Download and install?", abort=True, err=True)
    for name in names:
        with progress(1, shown=True) as update:
            install(
                PUBLISHED_NETWORKS[name],
                checkpoint=checkpoint,
                status=print_status,
                on_bytes=lambda received, size: update(received / size, "download"),
            )
        print_status(f"{name} is installed; use it with: --model {name}")
    clean(names)


@models.command
@_NETWORKS
def remove(*, names: tuple[str, ...]) -> None:
    """Remove installed networks, and the files of interrupted installations."""
    folder = PUBLISHED_NETWORKS[names[0]].folder.parent
    for name in (*names, "installing"):
        if (folder / name).exists():
            shutil.rmtree(folder / name)
            print_status(f"{folder / name} was removed")


@models.command("import")
@click.argument("source", type=FILE)
@click.argument("folder", type=FILE)
@click.option(
    "--base-model",
    metavar="MODEL",
    default="kontext",
    help=f"The base for which the model was trained: {', '.join(BACKBONE_COSTS)}, a folder or a "
    "hub id.",
)
@click.option(
    "--prompt",
    metavar="TEXT",
    required=True,
    help="The prompt with which it was trained. It is encoded once, with the text encoder of the "
    "base.",
)
@click.option(
    "--panels",
    metavar="PANELS",
    default="T",
    help="What it generates, separated by commas: T is the transmission, R the reflection, I the "
    "photo.",
)
@click.option(
    "--alpha",
    type=Number(1),
    help="For a file of peft without its adapter_config.json: the value lora_alpha with which it "
    "was trained.",
)
@click.option(
    "--device",
    type=click.Choice(["cpu", "cuda"]),
    default="cpu",
    help="The device that encodes the prompt.",
)
def import_model(
    *,
    source: Path,
    folder: Path,
    base_model: str,
    panels: str,
    **options: Any,  # noqa: ANN401
) -> None:
    """Convert a LoRA of another program to a FOLDER that --model opens.

    SOURCE is a LoRA for kontext, klein or qwen, a .safetensors file or a folder with one, with the
    keys of peft, diffusers, kohya or ComfyUI, and names of layers in diffusers. `hf download`
    downloads it from the hub.
    """
    require_extra("diffusion", "importing a LoRA")
    from brewster.diffusion.adapter.importer import import_lora  # noqa: PLC0415  (imports torch)

    names = cast("tuple[Panel, ...]", tuple(panels.split(",")))
    import_lora(source, folder, base_model=base_model, panels=names, **options)
    print_status(f"{source} -> {folder}; use it with: --model {folder}")


@models.command
@_NAME
@click.option(
    "--scores",
    metavar="FILE",
    type=FILE,
    help="First write the scores of this results.json of brewster evaluate into the card of the "
    "LoRA folder.",
)
def card(*, name: str, scores: Path | None) -> None:
    """Print the model card of a model or of a LoRA folder: licence, training data, scores,
    limitations.
    """
    if scores:
        _update_scores(Path(name), scores)
    is_folder = name not in registry.registered() and Path(name).is_dir()
    print_out(_read_card(Path(name)) if is_folder else registry.find(name).card())


@models.command
@_NAME
def path(*, name: str) -> None:
    """Print the path of a model file."""
    model = zoo.model_file(name)
    model.verify()
    print_out(model.path)


@models.command
@click.argument("names", nargs=-1, metavar="[NAME]...")
@JSON
@click.pass_context
def verify(context: click.Context, *, names: tuple[str, ...], as_json: bool) -> None:
    """Verify the checksums of the model files, by default of all models."""
    files = [zoo.model_file(name) for name in names] or zoo.installed_files()
    rows = [file.verified() for file in files]
    if as_json:
        print_out(json.dumps(rows))
    for row in rows:
        if row["error"]:
            print_error(row["error"])
        elif not as_json:
            print_out(f"{row['name']}: {row['sha256']}")
    context.exit(1 if any(row["error"] for row in rows) else 0)


def _read_card(folder: Path) -> str:
    path = folder / _CARD_FILE
    expected = "expected the card that brewster train writes into the folder lora"
    with read_errors(path, ModelError, expected, "give the path of the folder lora"):
        return path.read_text("utf-8")


def _update_scores(folder: Path, scores: Path) -> None:
    require_extra("train", "writing a model card")
    from brewster.diffusion.lora.model_card import with_benchmark_tables  # noqa: PLC0415
    from brewster.evaluation.report.tables import tables_to_markdown  # noqa: PLC0415  (imports torch)

    expected = "expected the results.json of brewster evaluate"
    cure = "give the path of the file with --scores"
    with read_errors(scores, ModelError, expected, cure, (ValueError, KeyError, TypeError)):
        results = json.loads(scores.read_text("utf-8"))
        lines = [
            tables_to_markdown(results),
            *(f"- {choice}" for choice in results["protocol"]["choices"]),
        ]
    text = with_benchmark_tables(_read_card(folder), "\n".join(lines))
    write_atomically(folder / _CARD_FILE, text.encode(), overwrite=True)
