#!/usr/bin/env bash
# The first run on real weights, at most three hours on a GPU with 24 GB (est. 2.5 hours on an RTX 4090, plus downloads
# of 76 GB).
#     BREWSTER_DATA=/data runs/first_gpu_day.sh [FOLDER]    writes to FOLDER, by default out/first-gpu-day
#     runs/first_gpu_day.sh --tiny [FOLDER]                 all steps with tiny models: minutes on a CPU, offline
# No part of brewster has run on real diffusion weights yet. This script answers two questions: does WindowSeat score in
# brewster what its authors report (26.60 dB on Real20, 27.57 dB on Nature20), and does the paper's LoRA learn from
# rendered samples?
# Send back FOLDER/report.html. It is one file, and contains reduced pictures of your copies of the benchmarks: do not
# publish it.
#
# Needs Linux, an NVIDIA GPU with 24 GB, 24 GB of memory, 90 GB of disk, and BREWSTER_DATA with real20/ and nature20/
# (layout: docs/evaluation.md). First run `pip install -c constraints.txt -e '.[render,train,diffusion,evaluate]'
# bitsandbytes`, agree to the licence at https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev (not for commercial
# use), and run `hf auth login`. The script checks all of this first, and lists everything that is missing. Give the
# same command again to resume an interrupted run.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
tiny=false
if [ "${1:-}" = --tiny ]; then tiny=true; shift; fi
$tiny && default=$root/out/first-gpu-day-tiny || default=$root/out/first-gpu-day
out=$(realpath -m "${1:-$default}")
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
install="python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e '.[render,train,diffusion,evaluate]'"
command -v brewster > /dev/null || { echo "error: brewster is not installed; run: $install" >&2; exit 1; }
python="$(dirname "$(command -v brewster)")/python"
[ -x "$python" ] || python=python3
script() { PYTHONPATH="$root/src:$root/tests${PYTHONPATH:+:$PYTHONPATH}" "$python" "$root/runs/first_gpu_day.py" "$@"; }

# 1. Check the machine: everything that a later step needs.
if $tiny; then
    brewster doctor --needs render,train,diffusion,evaluate
    export OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1
    data=$out/benchmarks windowseat=$out/windowseat-model recipe=$root/recipes/train/lora-tiny.toml set=sets/tiny
    maps=() size=96x72 train_count=4 test_count=2 quality=(--quality draft) workers=(--workers 0)
else
    script check "${BREWSTER_DATA:-}" "$out"
    data=$(realpath "$BREWSTER_DATA") windowseat=windowseat set=sets/train
    recipe=$root/recipes/train/kontext-first-day.toml
    maps=(--maps "$out/maps") size=336x256 train_count=400 test_count=20 quality=() workers=()
fi
export BREWSTER_DATA="$out"
mkdir -p "$out"
cd "$root"
brewster doctor > "$out/doctor.txt" || true
finished() { echo "$1,$SECONDS" >> "$out/seconds.csv"; echo "== $1: finished after $((SECONDS / 60)) minutes"; }
render() {
    brewster render "$out/$1" --recipe "$2" --seed "$3" --count "$4" --size "$size" --quiet "${maps[@]}" "${workers[@]}"
}
evaluate() {
    brewster evaluate --benchmark "real20=$data/real20" --benchmark "nature20=$data/nature20" --metrics psnr,ssim \
        --predictions "WindowSeat=$out/windowseat" --model "WindowSeat-guided=$windowseat" --model compact \
        "${quality[@]}" -o "$out/evaluate" "$@"
}

steps() {
    set -e
    $tiny && script write-tiny "$out"  # the tiny WindowSeat, and rendered pairs in place of Real20 and Nature20

    # 2. WindowSeat on Real20 and Nature20, as its authors run it: without guided upsampling. est. 10 minutes.
    for name in real20 nature20; do
        brewster "$data/$name/blended" --model "$windowseat" --no-guided-upsampling --layers transmission --format png \
            -o "$out/windowseat/$name" --quiet
    done
    #    Score these pictures, WindowSeat with guided upsampling (the default of brewster), the compact model, and the
    #    unprocessed input.
    evaluate
    finished "WindowSeat"

    # 3. Render 400 samples for training and 20 for testing, with 60 CC0 maps of Poly Haven. est. 10 minutes, most for
    # the download.
    $tiny || brewster assets pull polyhaven "$out/maps" --indoor 40 --outdoor 20 --resolution 2k --quiet
    if $tiny; then recipes=tiny; else recipes=recipes/render/paper.toml; fi
    render "$set" "$recipes" 10 "$train_count"
    render sets/test "$recipes" 11 "$test_count"
    finished "rendering"

    # 4. Train the paper's LoRA: rank 16, 4,000 steps. est. 1.8 hours. Then separate both benchmarks and the test set
    # with it. est. 20 minutes.
    brewster train "$recipe" -o "$out/lora-run"
    finished "training"
    evaluate --model "LoRA=$out/lora-run/lora"
    brewster evaluate --benchmark "rendered=$out/sets/test" --metrics psnr,ssim --model compact \
        --model "LoRA=$out/lora-run/lora" \
        "${quality[@]}" -o "$out/evaluate-rendered"
    finished "evaluation of the LoRA"

}
set +e
(steps) 2>&1 | tee -a "$out/log.txt"
status=${PIPESTATUS[0]}
set -e

# 5. Write the report, also after an error: it then contains the end of the log.
$tiny && kind=tiny || kind=full
BENCHMARKS="$data" script report "$out" "$status" "$kind"
exit "$status"
