#!/usr/bin/env bash
# Measures memory and time of the paper's method at full size for a 24 GB GPU. The architectures are real, the weights
# are random, and nothing is downloaded.
#     runs/full_size_check.sh            measures on a GPU, in a few minutes
#     runs/full_size_check.sh --tiny     tests this script with tiny backbones, on any machine, in half a minute
# The backbones are FLUX.1 Kontext (11.9 billion weights, int8 by torchao) and FLUX.2 klein (3.9 billion weights, bf16).
# The script trains a LoRA of rank 16 for seven steps, on a composite of 1536 x 512 and its condition, with gradient
# checkpointing. Then it separates a photo in 20 steps. Memory is limited to 23 GiB. The script writes full_size.json
# and full_size.md to $OUT, by default out/full_size. The exit code is 1 if a backbone does not fit into memory. The
# script needs src/, and torch, diffusers, peft, accelerate, safetensors, torchao and huggingface_hub from the extra
# `diffusion`. On a machine without a network connection, install the missing packages from wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
if [ -x .venv/bin/python ]; then python=.venv/bin/python; else python=python3; fi
missing=$("$python" -c 'import sys, importlib.util as i; print(*(n for n in sys.argv[1:] if not i.find_spec(n)))' \
    torch diffusers peft accelerate safetensors torchao huggingface_hub)
if [ -n "$missing" ]; then
    echo "error: not installed: $missing; expected the extra diffusion;" \
        "run: pip install -c constraints.txt -e '.[diffusion]'." >&2
    exit 1
fi
PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}" HF_HUB_OFFLINE=1 PYTHONUNBUFFERED=1 \
    exec "$python" runs/full_size_check.py --out "${OUT:-out/full_size}" "$@"
