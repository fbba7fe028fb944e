#!/usr/bin/env bash
# Does the paper's size fit a 24 GB card, and how long does it take? Real architectures, random weights, no download.
#     runs/full_size_check.sh            on a GPU: measured, in a few minutes; without one: estimates, and says so
#     runs/full_size_check.sh --tiny     a rehearsal: the same code on toy twins, on any machine, in half a minute
# FLUX.1 Kontext (11.9 billion weights, int8 by torchao) and FLUX.2 klein (3.9 billion, bf16): a LoRA of rank 16 on a composite
# of 1536 x 512 and its condition, gradient checkpointing, seven steps; then a photo in 20 steps. Memory is capped at 23 GiB.
# full_size.json and full_size.md go to $OUT, else to out/full_size. The exit code is 1 if anything did not fit.
# It needs of brewster only src/, and of the extra `large` torch, diffusers, peft, accelerate, safetensors, torchao and
# huggingface_hub: on a machine without a network, carry those that it lacks as wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
if [ -x .venv/bin/python ]; then python=.venv/bin/python; else python=python3; fi
PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}" HF_HUB_OFFLINE=1 PYTHONUNBUFFERED=1 \
    exec "$python" runs/full_size_check.py --out "${OUT:-out/full_size}" "$@"
