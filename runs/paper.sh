#!/usr/bin/env bash
# The paper's method at the paper's size: FLUX.1 Kontext [dev], rank 16, 4,000 steps, one 24 GB GPU (RTX 4090).
#     BREWSTER_DATA=/big/disk runs/paper.sh [FOLDER]     writes to FOLDER, by default out/paper
#     runs/paper.sh --tiny [FOLDER]                      the same with a tiny backbone: minutes on two cores, offline
# Give the same command again to resume an interrupted run. With --tiny, the generated panels are noise, but every step
# runs.
#
# First run `pip install -c constraints.txt -e '.[render,train,diffusion,evaluate]' bitsandbytes`, agree to the licence
# at https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev (not for commercial use), and run `hf auth login`.
# BREWSTER_DATA must contain photos/ (200 photos of people, animals and artworks), pairs/real and pairs/nature (the 89 +
# 200 training pairs), real20, nature20 and SIR2 (the benchmarks; docs/evaluation.md describes their layouts), and
# real/dev/nature (any pairs, for validation during training). LPIPS needs a download of 233 MiB, or
# weights/lpips_alexnet_features.pth.
#
# "est." marks estimates, which are calculated.
# runs/full_size_check.sh measures memory and time per step on your GPU.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
tiny=false
if [ "${1:-}" = --tiny ]; then tiny=true; shift; fi
$tiny && default=$root/out/paper-tiny || default=$root/out/paper
out=$(realpath -m "${1:-$default}")
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
install="python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e '.[render,train,diffusion,evaluate]'"
command -v brewster > /dev/null || { echo "error: brewster is not installed; run: $install" >&2; exit 1; }
brewster doctor --needs render,train,diffusion,evaluate
if $tiny; then
    export BREWSTER_DATA="$out/data" OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1
    mkdir -p "$BREWSTER_DATA"
    size=96x72 test_count=2 suffix=-tiny sizes=(0 2 4)
    assets=() syn=recipes/train/lora-tiny.toml real=recipes/train/lora-real-tiny.toml set=sets/tiny count=4
    options=(--quality draft --metrics "psnr,ssim,removed_white,kept_reflection")
    benchmarks=(--benchmark "rendered=$BREWSTER_DATA/sets/test") quality=(--quality draft) workers=(--workers 0)
else
    : "${BREWSTER_DATA:?is not set; expected the folder of the data, with 20 GB free; export BREWSTER_DATA=/path}"
    BREWSTER_DATA="$(realpath "$BREWSTER_DATA")"
    export BREWSTER_DATA
    missing=()
    for folder in photos pairs/real pairs/nature real20 nature20 SIR2 real/dev/nature; do
        [ -d "$BREWSTER_DATA/$folder" ] || missing+=("$folder")
    done
    if [ ${#missing[@]} -gt 0 ]; then
        echo "error: $BREWSTER_DATA has no ${missing[*]}; expected the folders at the top of $0; add them." >&2
        exit 1
    fi
    size=640x480 test_count=40 suffix="" sizes=(0 10 50 100 300 1000)
    assets=(--maps "$BREWSTER_DATA/hdri" --photos "$BREWSTER_DATA/photos")
    syn=recipes/train/kontext.toml real=recipes/train/kontext-real.toml set=sets/paper count=1000
    benchmarks=(--benchmark "real20=$BREWSTER_DATA/real20" --benchmark "nature20=$BREWSTER_DATA/nature20"
        --benchmark "sir2=$BREWSTER_DATA/SIR2")
    options=(--protocol paper) quality=() workers=()
fi
cd "$root"

# 1. Download environment maps: 170 HDR maps of Poly Haven, CC0, 4k (est. 4 GB). The paper also has 110 city maps of
#    UrbanSky, which may not be redistributed: put your own copies into the same folder. With --tiny, the built-in
#    environments are used.
$tiny || brewster assets pull polyhaven "$BREWSTER_DATA/hdri" --indoor 140 --outdoor 30 --resolution 4k

# 2. Render 1,000 samples for training, and 40 for testing, with the paper's three set-ups and also rough panes. In the
#    training samples, T and R contain the paper's single light paths. A sample has 5 MB and needs est. 2.5-4
#    CPU-seconds, more if rough.
render() {
    brewster render "$BREWSTER_DATA/$1" --recipe recipes/render/paper.toml --size "$size" --seed "$2" \
        --count "$3" "${@:4}"
}
render "$set" 10 "$count" "${assets[@]}" "${workers[@]}"
render sets/test 11 "$test_count" --orders all "${assets[@]}" "${workers[@]}" # all: I = T + R, for the failure metrics

# With --tiny, two more rendered samples replace the 289 real pairs.
if $tiny; then
    brewster render "$BREWSTER_DATA/sets/pairs" --recipe tiny --size 64x64 --seed 12 --count 2 --workers 0
    mkdir -p "$BREWSTER_DATA"/pairs/tiny/{blended,transmission}
    for number in 000000 000001; do
        cp "$BREWSTER_DATA/sets/pairs/$number/photo.jpg" "$BREWSTER_DATA/pairs/tiny/blended/$number.jpg"
        cp "$BREWSTER_DATA/sets/pairs/$number/transmission.jpg" "$BREWSTER_DATA/pairs/tiny/transmission/$number.jpg"
    done
fi

# 3. Evaluate the compact model. The script stops here if a benchmark is missing or incomplete, or if LPIPS has no
# weights.
#    Step 6 and the ablations in step 7 need both. Step 6 keeps these scores.
evaluate() { brewster evaluate "${benchmarks[@]}" "${options[@]}" --model compact -o "$out/evaluate" "$@"; }
evaluate

# 4. Train "syn" and "syn + real". The base model is downloaded once (est. 34 GB, 10 GB of which are the text encoders).
#    A training needs est. 17.7 GiB (base model in int8 11.2, activations 3.5, LoRA and AdamW 1.3, other 1.7). A step
#    takes est. 5.3 s on an RTX 4090, and each training run 5.9 hours. A checkpoint has est. 1 GB, a LoRA 344 MB.
brewster train "$syn" -o "$out/syn"
brewster train "$real" -o "$out/syn+real"

# 5. Separate a photo. A prediction of 20 steps takes est. 35 s.
brewster tests/pictures/mixture-coffee-rocket.jpg --model "$out/syn/lora" -o "$out/separated" --overwrite \
    "${quality[@]}"

# 6. Evaluate both LoRAs, the compact model, and the unprocessed input. This takes est. 5-6 hours for each model. The
#    paper's Table 1 is table.tex. The rendered test set is for the paper's failure cases: removed white areas, and kept
#    reflections.
loras=(--model "syn=$out/syn/lora" --model "syn+real=$out/syn+real/lora")
brewster evaluate --benchmark "rendered=$BREWSTER_DATA/sets/test" "${quality[@]}" --model compact "${loras[@]}" \
    --metrics psnr,ssim,removed_content,removed_white,kept_reflection -o "$out/failures"
evaluate "${loras[@]}"
cp "$out/evaluate/table.tex" "$out/table1.tex"

# 7. Run the paper's ablations on the diffusion model: 8-bit blends, number of samples, prompts without training. est.
# 2-3 days.
ablate() {  # NAME RECIPE KEY VALUE...
    local value run models=()
    for value in "${@:4}"; do
        run=$out/ablations/$1/$value
        brewster train "$2" --set "$3=$value" -o "$run"
        models+=(--model "${3##*.} $value=$run/lora")
    done
    brewster evaluate "${benchmarks[@]}" "${options[@]}" "${models[@]}" -o "$out/ablations/$1"
}
ablate blend_space "$syn" data.rendered.blend_space linear srgb
ablate size "$syn" data.rendered.count "${sizes[@]}"
ablate prompt "recipes/ablations/no-lora$suffix.toml" prompt none generic detailed

# 8. Write the model card with these scores. To publish the LoRA (350 MB), under the licence of its base model:
#    hf upload OWNER/NAME out/paper/syn/lora --private
brewster models card "$out/syn/lora" --scores "$out/evaluate/results.json" > "$out/card.md"
