#!/usr/bin/env bash
# The paper's method at the paper's size: FLUX.1 Kontext [dev], rank 16, 4,000 steps, one 24 GB card (RTX 4090).
#     BREWSTER_DATA=/big/disk runs/paper.sh [FOLDER]        writes out/kontext, or FOLDER
# It goes on where it was stopped: give the same command again. runs/tiny.sh is the same play in two minutes on a CPU.
#
# Before: pip install -c constraints.txt '.[render,train,large,evaluate]' bitsandbytes; agree to the licence at
# https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev (not for commercial use), and `hf auth login`.
# The benchmarks are your own copies; docs/evaluation.md has their layouts. real/dev/nature in BREWSTER_DATA is any folder of
# pairs to look at while training (blended/, transmission/); recipes/train/kontext.toml names it.
#
# "est." marks numbers that nobody has measured: from `brewster train recipes/train/kontext.toml --plan`, or arithmetic.
# runs/full_size_check.sh measures memory and the time of a step on the card that you have.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
out=$(realpath -m "${1:-$root/out/kontext}")
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
: "${BREWSTER_DATA:?names no folder: it holds the data, and needs 10 GB}"
BREWSTER_DATA="$(realpath "$BREWSTER_DATA")"
export BREWSTER_DATA
cd "$root"
real20=${REAL20:-$BREWSTER_DATA/real20} nature20=${NATURE20:-$BREWSTER_DATA/nature20} sir2=${SIR2:-$BREWSTER_DATA/SIR2}

# 1. Worlds: 170 HDR maps of Poly Haven, CC0, 4k.   est. 4 GB
brewster assets pull polyhaven "$BREWSTER_DATA/hdri" --indoor 140 --outdoor 30 --resolution 4k

# 2. A thousand sets, the paper's orders (T is the path without any reflection).
#    5 MB a set as measured with the builtin worlds, 5 GB in all; est. 2.5-4 CPU-seconds a set (docs/rendering.md, scaled to
#    this size): an hour on one core, 10 minutes on eight. Photos of your own to put before maps help: --photos DIR.
brewster render "$BREWSTER_DATA/sets/window" --recipe window --count 1000 --size 640x480 --orders paper --seed 10 \
    --maps "$BREWSTER_DATA/hdri"

# 3. What it will take, before anything is downloaded; stops here if it does not fit the card.
#    est. 17.7 GiB: base in int8 11.2, activations 3.5, LoRA and AdamW 1.3, the rest 1.7
brewster train recipes/train/kontext.toml --plan

# 4. Learn. Downloads the base once (est. 34 GB in the hub's cache, of which 10 GB are the text encoders, needed for one
#    prompt), then est. 5.3 s a step on an RTX 4090, 5.9 hours in all. The checkpoint is est. 1 GB, the LoRA 344 MB.
brewster train recipes/train/kontext.toml -o "$out"

# 5. Separate.   est. 35 s for each look of 20 steps
brewster tests/pictures/mixture-coffee-rocket.jpg --model "$out/lora" -o "$out/separated" --overwrite

# 6. Measure: 540 pictures, est. 5-6 hours of looking. The unprocessed input and the compact model stand beside.
brewster evaluate --benchmark "real20=$real20" --benchmark "nature20=$nature20" --benchmark "sir2=$sir2" \
    --model compact --model "lora=$out/lora" --paper -o "$out/evaluate"

# 7. What leaves: the card with these scores, and what the hub would get, 350 MB. Without --dry-run it is sent, for you alone
#    to see; --public shows it to everybody, under the licence of the base.
brewster models card "$out/lora" --scores "$out/evaluate/results.json" > "$out/card.md"
brewster models push "$out/lora" "${REPO:-somebody/sees-through-glass}" --dry-run
