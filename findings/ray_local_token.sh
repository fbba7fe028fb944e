#!/usr/bin/env bash
# A local Ray cluster leaves a token in the home folder, and the next cluster of the user requires it.
#
# Seen with Ray 2.60: ray.init("local") creates ~/.ray/auth_token, although the cluster ends with the
# program. From then on, `ray start --head` finds the file and protects the cluster with it. Other
# machines do not have the file, so they cannot join. Even a program of the same user on the same
# machine is refused: it sends the token only if RAY_AUTH_MODE=token is in its environment, while
# `ray start` decides by the file alone.
#
# A token in RAY_AUTH_TOKEN is used without being written. This script needs Linux and half a minute.
set -euo pipefail

folder=$(mktemp -d)
head=""
finish() {
    if [ -n "$head" ]; then kill -TERM -- "-$head" 2>/dev/null || true; sleep 2; fi
    rm -rf "$folder"
}
trap finish EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet "ray[default]==2.60.0"
export HOME="$folder/home" RAY_USAGE_STATS_ENABLED=0 PATH="$folder/venv/bin:$PATH"
unset RAY_AUTH_MODE RAY_AUTH_TOKEN RAY_AUTH_TOKEN_PATH
mkdir -p "$HOME"
python -c 'import sys, ray; print("Python", sys.version.split()[0], "Ray", ray.__version__)'

local_cluster='
import ray
ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
ray.shutdown()'

RAY_AUTH_TOKEN=00112233445566778899aabbccddeeff python -c "$local_cluster" 2>/dev/null
[ ! -e "$HOME/.ray/auth_token" ] || { echo "changed: a token of the environment was written"; exit 1; }
echo "local cluster with RAY_AUTH_TOKEN: no file"
python -c "$local_cluster" 2>/dev/null
[ -e "$HOME/.ray/auth_token" ] || { echo "changed: no token is left"; exit 1; }
echo "local cluster: ~/.ray/auth_token is left"

setsid ray start --head --port=6396 --num-cpus=1 --include-dashboard=false \
    --temp-dir="$folder/ray" --block >"$folder/head.log" 2>&1 &
head=$!
sleep 20
join='
import ray
ray.init("127.0.0.1:6396", log_to_driver=False, logging_level="error")
print("joined")'
if timeout 60 python -c "$join" >"$folder/join.log" 2>&1; then
    echo "changed: a program of the same user joins without RAY_AUTH_MODE"; exit 1
fi
echo "a program of the same user: refused"
RAY_AUTH_MODE=token timeout 60 python -c "$join" 2>/dev/null
