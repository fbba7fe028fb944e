#!/usr/bin/env bash
# The paper's method at the paper's size: FLUX.1 Kontext [dev], rank 16, 4,000 steps, one 24 GB card (RTX 4090).
#     BREWSTER_DATA=/big/disk runs/paper.sh [FOLDER]        writes to FOLDER, by default out/kontext
# Give the same command again to resume an interrupted run. runs/tiny.sh is the same experiment in two minutes on a CPU.
#
# First: pip install -c constraints.txt '.[render,train,large,evaluate]' bitsandbytes; agree to the licence at
# https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev (not for commercial use), and run `hf auth login`.
# The benchmarks are your own copies; docs/evaluation.md describes their layouts. recipes/train/kontext.toml validates on
# real/dev/nature in BREWSTER_DATA, which can be any folder of pairs (blended/, transmission/).
#
# "est." marks estimates that were not measured: from `brewster train recipes/train/kontext.toml --plan`, or arithmetic.
# runs/full_size_check.sh measures memory and time per step on your card.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
out=$(realpath -m "${1:-$root/out/kontext}")
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
: "${BREWSTER_DATA:?is not set; expected the folder of the data, with 10 GB free; export BREWSTER_DATA=/path/to/data}"
BREWSTER_DATA="$(realpath "$BREWSTER_DATA")"
export BREWSTER_DATA
cd "$root"
real20=${REAL20:-$BREWSTER_DATA/real20} nature20=${NATURE20:-$BREWSTER_DATA/nature20} sir2=${SIR2:-$BREWSTER_DATA/SIR2}

# 1. Download environment maps: 170 HDR maps of Poly Haven, CC0, 4k.   est. 4 GB
brewster assets pull polyhaven "$BREWSTER_DATA/hdri" --indoor 140 --outdoor 30 --resolution 4k

# 2. Render 1,000 samples with truncated orders of reflection, as in the paper (T is the path without any reflection).
#    5 MB per sample, measured with the built-in environments, 5 GB in total; est. 2.5-4 CPU-seconds per sample
#    (docs/rendering.md, scaled to this size): an hour on one core, 10 minutes on eight. Your own photos in front of the maps
#    improve the data: --photos FOLDER.
brewster render "$BREWSTER_DATA/sets/window" --recipe window --count 1000 --size 640x480 --orders truncated --seed 10 \
    --maps "$BREWSTER_DATA/hdri"

# 3. Estimate memory and time before anything is downloaded. The script stops here if training does not fit the card.
#    est. 17.7 GiB: base in int8 11.2, activations 3.5, LoRA and AdamW 1.3, the rest 1.7
brewster train recipes/train/kontext.toml --plan

# 4. Train. Downloads the base once (est. 34 GB in the hub's cache; 10 GB of it are the text encoders, which encode one prompt).
#    est. 5.3 s per step on an RTX 4090, 5.9 hours in total. The checkpoint is est. 1 GB, the LoRA 344 MB.
brewster train recipes/train/kontext.toml -o "$out"

# 5. Separate a photo.   est. 35 s per prediction of 20 steps
brewster tests/pictures/mixture-coffee-rocket.jpg --model "$out/lora" -o "$out/separated" --overwrite

# 6. Evaluate on 540 photos, est. 5-6 hours, with the unprocessed input and the compact model for comparison.
brewster evaluate --benchmark "real20=$real20" --benchmark "nature20=$nature20" --benchmark "sir2=$sir2" \
    --model compact --model "lora=$out/lora" --protocol paper -o "$out/evaluate"

# 7. Write the model card with these scores, and list the files for the hub, 350 MB. Without --dry-run, the command uploads
#    them as a private repository; with --public the repository is public, under the licence of the base.
brewster models card "$out/lora" --scores "$out/evaluate/results.json" > "$out/card.md"
brewster models push "$out/lora" "${REPO:-somebody/sees-through-glass}" --dry-run
