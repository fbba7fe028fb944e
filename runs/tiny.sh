#!/usr/bin/env bash
# The whole of the paper's method with a tiny version of the backbone: one or two minutes on two CPU cores, offline.
#     runs/tiny.sh [FOLDER]        writes to FOLDER, by default out/tiny
# The tiny version has random weights, and its LoRA is trained for six steps. All parts are tested, but the generated
# panels are noise. runs/paper.sh is the same experiment at the paper's size.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
out=$(realpath -m "${1:-$root/out/tiny}")
cd "$root"
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
install="python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e '.[render,train,diffusion,evaluate]'"
command -v brewster > /dev/null || { echo "error: brewster is not installed; run: $install" >&2; exit 1; }
brewster doctor --needs render,train,diffusion,evaluate
export BREWSTER_DATA="$out" OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1

# 1. Render samples with known ground truth: four for training, two more for evaluation.
brewster render "$out/sets/tiny" --recipe tiny --count 4 --workers 0 --quiet
brewster render "$out/sets/test" --recipe tiny --first 4 --count 2 --workers 0 --quiet

# 2. Train a LoRA of rank 4 on a tiny version of FLUX.1 Kontext, from [I, white, white] to [I, T, R].
brewster train recipes/train/lora-tiny.toml -o "$out"

# 3. Separate a photo, with the same tiling, colour handling and guided upsampling as for other models.
brewster tests/pictures/mixture-coffee-rocket.jpg --model "$out/lora" --quality draft -o "$out/separated" --overwrite

# 4. Evaluate the LoRA, the compact model, and the unprocessed input as baseline. Two small images in draft quality test
#    the evaluation, and say nothing about a method: docs/results.md has the scores of the compact model.
brewster evaluate --benchmark "rendered=$out/sets/test" --model compact --model "lora=$out/lora" \
    --quality draft --metrics psnr,ssim -o "$out/evaluate"

# 5. Write the model card with these scores. `hf upload OWNER/NAME FOLDER` would publish the folder.
brewster models card "$out/lora" --scores "$out/evaluate/results.json" > "$out/card.md"
