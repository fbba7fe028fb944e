#!/usr/bin/env bash
# The paper's method from beginning to end, on a toy: a minute or two on two CPU cores, no network, nothing to download.
#     runs/tiny.sh [FOLDER]        writes out/tiny, or FOLDER
# The toy twin has random weights and learns for six steps: every part is real, and what it draws is noise.
# runs/paper.sh is the same play at the paper's size.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
out=$(realpath -m "${1:-$root/out/tiny}")
cd "$root"
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
export BREWSTER_DATA="$out" OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1

# 1. Glass pictures whose truth is known: four to learn from, and two others to be judged on.
brewster render "$out/sets/tiny" --recipe tiny --count 4 --workers 0 --quiet
brewster render "$out/sets/judged" --recipe tiny --first 4 --count 2 --workers 0 --quiet

# 2. Learn: a LoRA of rank 4 on a toy twin of FLUX.1 Kontext, from [I, white, white] to [I, T, R].
brewster train recipes/train/large-tiny.toml -o "$out"

# 3. Separate a photograph, through the same tiles, colours and detail as every other model.
brewster tests/pictures/mixture-coffee-rocket.jpg --model "$out/lora" --quality draft -o "$out/separated" --overwrite

# 4. Measure it beside the compact model and beside the unprocessed input.
brewster evaluate --benchmark "rendered=$out/sets/judged" --model compact --model "lora=$out/lora" \
    --quality draft --metrics psnr,ssim -o "$out/evaluate"

# 5. What would leave: the card with these scores, and the four files that the hub would get.
brewster models card "$out/lora" --scores "$out/evaluate/results.json" > "$out/card.md"
brewster models push "$out/lora" somebody/sees-through-toy-glass --dry-run
