"""Parts of first_networks_day.sh: installs tiny networks for --tiny, and writes the report.

first_networks_day.py tiny OUT                 installs tiny networks, and writes pairs in
                                               place of the benchmarks
first_networks_day.py report OUT NETWORK...    writes OUT/report.md from the results of both
                                               evaluations
"""

import json
import sys
from pathlib import Path

import numpy as np

from brewster import Photo
from brewster.separation.models import network_install
from brewster.separation.models.published_networks import PROTOCOL, PUBLISHED_NETWORKS

PAPERS = {"dsrnet": "Real20 23.9 to 25.0", "rdnet": "Real20 25.6", "dsit": "Real20 23.82"}
"""PSNR per set as papers report it."""
AGREEMENT_DB = 0.3


def tiny(out):
    """Installs the tiny networks of the tests, and writes two pairs for each benchmark."""
    import tiny_networks  # noqa: PLC0415  (of tests/)

    network_install.CODE_DIGEST = network_install.code_digest(tiny_networks.TINY_SOURCE)
    tiny_networks.prepare_installation()
    for name in tiny_networks.OPTIONS:
        if not PUBLISHED_NETWORKS[name].installed():
            checkpoint = tiny_networks.tiny_checkpoint(name, out / f"{name}.ckpt")
            network_install.install(PUBLISHED_NETWORKS[name], checkpoint=checkpoint)
    rng = np.random.default_rng(1)
    for benchmark in ("real20", "nature20"):
        for index in range(2):
            truth = np.kron(rng.integers(0, 160, (4, 6, 3)), np.ones((16, 16, 1)))
            pair = {"transmission_layer": truth, "blended": truth + rng.integers(10, 60, 3)}
            for folder, pixels in pair.items():
                path = out / "benchmarks" / benchmark / folder / f"{index}.png"
                Photo.from_array(pixels.astype(np.uint8), encoding="srgb").save(
                    path, overwrite=True
                )


def mean_psnr(results, method):
    """Returns the mean over all pictures, each with the same weight, as XReflection; and their
    number.
    """
    scores = [
        case["scores"][method]["psnr_channels"]
        for case in results["cases"]
        if method in case["scores"]
    ]
    return float(np.mean(scores)), len(scores)


def report(out, networks):
    lines = ["# The first run on published weights", "", f"Published: {PROTOCOL}.", ""]
    lines += [
        "| method | quality | PSNR, dB | pictures | published | difference | papers |",
        "|---|---|---|---|---|---|---|",
    ]
    for quality in ("draft", "standard"):
        results = json.loads((out / f"evaluate-{quality}" / "results.json").read_text())
        for method in results["methods"]:
            score, count = mean_psnr(results, method)
            network = PUBLISHED_NETWORKS.get(method)
            published = float(network.psnr) if network else None
            cells = (
                [published, f"{score - published:+.2f}", PAPERS[method]]
                if network
                else ["", "", ""]
            )
            lines.append(
                f"| {method} | {quality} | {score:.2f} | {count} | "
                + " | ".join(map(str, cells))
                + " |"
            )
    lines += [
        "",
        (
            f"A difference of less than {AGREEMENT_DB} dB at quality draft, over the same 494 "
            "pictures, is agreement."
        ),
        "",
    ]
    for name in networks:
        facts = json.dumps(PUBLISHED_NETWORKS[name].installed())
        lines.append(f"- {name}: {facts}")
    lines += [
        "",
        (
            "Pictures: evaluate-draft/report.html and evaluate-standard/report.html; scores: "
            "tables.md beside them."
        ),
    ]
    (out / "report.md").write_text("\n".join(lines) + "\n")
    print(f"the report is {out / 'report.md'}")


if __name__ == "__main__":
    task, folder, *names = sys.argv[1:]
    if task == "tiny":
        tiny(Path(folder))
    else:
        report(Path(folder), names)
