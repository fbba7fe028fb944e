#!/usr/bin/env bash
# The first run on the published weights of DSRNet, RDNet and DSIT, for a person with internet; no GPU is needed.
#     BREWSTER_DATA=/data runs/first_networks_day.sh [FOLDER]    writes to FOLDER, by default out/first-networks-day
#     runs/first_networks_day.sh --tiny [FOLDER]                 all steps with tiny networks: minutes, offline
# brewster has run these networks with random weights and their authors' code only, not yet with their weights. This
# script answers whether they score in brewster what their authors report: 25.89 (DSRNet), 26.48 (RDNet), 26.70 dB
# (DSIT), averages over 494 pictures. Send back FOLDER/report.md and FOLDER/evaluate-*/report.html. They contain reduced
# pictures of your benchmarks: do not publish them.
#
# Downloads from checkpoints.mingjia.li three checkpoints of 0.7 to 4 GB each, the code of XReflection, and packages
# with torch of 1 to 4 GB; needs 20 GB of disk, 12 GB of memory (DSIT; 8 GB for the others), and est. 12 hours on two
# cores, 3 on eight. BREWSTER_DATA has real20/, nature20/ and SIR2/ (layout: docs/evaluation.md; the averages contain 55
# wild scenes, so put those into SIR2/Wildscene). First run: pip install -c constraints.txt -e '.[evaluate]'. Give the
# same command again to resume.
set -euo pipefail
root="$(realpath "$(dirname "$0")/..")"
tiny=false
if [ "${1:-}" = --tiny ]; then tiny=true; shift; fi
$tiny && default=$root/out/first-networks-day-tiny || default=$root/out/first-networks-day
out=$(realpath -m "${1:-$default}")
command -v brewster > /dev/null || export PATH="$PWD/.venv/bin:$PATH"
install="python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e '.[evaluate]'"
command -v brewster > /dev/null || { echo "error: brewster is not installed; run: $install" >&2; exit 1; }
python="$(dirname "$(command -v brewster)")/python"
[ -x "$python" ] || python=python3
script() {
    PYTHONPATH="$root/src:$root/tests${PYTHONPATH:+:$PYTHONPATH}" "$python" "$root/runs/first_networks_day.py" "$@"
}
mkdir -p "$out"

# 1. Check the benchmarks, and install the networks. An installed network is kept.
if $tiny; then
    export XDG_CACHE_HOME="$out/cache" OMP_NUM_THREADS=1
    networks=(rdnet dsrnet)
    script tiny "$out"
    data=$out/benchmarks
    benchmarks=(--benchmark "real20=$out/benchmarks/real20" --benchmark "nature20=$out/benchmarks/nature20")
else
    : "${BREWSTER_DATA:?is not set; expected the folder with real20, nature20 and SIR2; export BREWSTER_DATA=/path}"
    networks=(dsrnet rdnet dsit)
    data=$(realpath "$BREWSTER_DATA")
    benchmarks=(--benchmark "real20=$data/real20" --benchmark "nature20=$data/nature20" --benchmark "sir2=$data/SIR2")
    brewster doctor --needs evaluate
    brewster evaluate "${benchmarks[@]}" --model compact --protocol xreflection --dry-run > "$out/pictures.txt"
    for name in "${networks[@]}"; do
        brewster models path "$name" > /dev/null 2>&1 || brewster models install "$name" --yes
    done
fi

# 2. Separate and score: draft is one pass, as the authors test; standard is brewster's default. Finished pictures are
# kept.
models=()
for name in "${networks[@]}"; do models+=(--model "$name"); done
for quality in draft standard; do
    brewster evaluate "${benchmarks[@]}" "${models[@]}" --model compact --protocol xreflection --quality "$quality" \
        -o "$out/evaluate-$quality"
done

# 3. Write the report: averages beside the published ones, the input, seconds and memory.
script report "$out" "${networks[@]}"
