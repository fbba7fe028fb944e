#!/usr/bin/env bash
# Trains the compact model that is part of brewster, from photos, HDR maps and ImageNet weights.
#     BREWSTER_DATA=/path/to/data runs/compact.sh          writes to out/compact-*; the model is out/compact-final/model.onnx
# Give the same command again to resume an interrupted run. It takes about 15 hours on two CPU cores with AVX512_BF16.
#
# BREWSTER_DATA contains photos/permissive (with manifest.csv), hdri/, and real/ (pairs for validation; they are not trained on).
# First install the extras: pip install -c constraints.txt -e '.[render,train]'
set -euo pipefail
cd "$(dirname "$0")/.."
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
: "${BREWSTER_DATA:?is not set; expected the folder of the data; export BREWSTER_DATA=/path/to/data}"
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-2}

# 1. Link the photos and maps for training: all except excluded and held-out files.
clean=$BREWSTER_DATA/clean
mkdir -p "$clean/photos" "$clean/maps"
find "$BREWSTER_DATA/photos/permissive" -name '*.jpg' ! -name 'debian_wallpapers__*' ! -name 'kodak24__*' \
    ! -name 'gianni-rosato-gb82*' -exec ln -sf -t "$clean/photos" {} +
find "$BREWSTER_DATA/hdri" \( -name '*.hdr' -o -name '*.exr' \) ! -name 'blender_*' -exec ln -sf -t "$clean/maps" {} +

# 2. Render 1,500 samples, in a few minutes.
seed=50
for set in window:600 shopfront:300 office:300 vitrine:300; do
    brewster render "$BREWSTER_DATA/sets/${set%:*}" --recipe "${set%:*}" --count "${set#*:}" --seed $((seed++)) \
        --size 256x256 --maps "$clean/maps" --photos "$clean/photos"
done

# 3. Train all stages.
for stage in stage1 stage2 sharp stage3 stage4 stage5 stage6 stage7 stage8 stage9 stage10 mean stage11 stage12 final; do
    brewster train "recipes/train/compact-$stage.toml" -o "out/compact-$stage"
done
