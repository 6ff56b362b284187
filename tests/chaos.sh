#!/bin/bash
# Five aircraft, a ground and an attacker over bad links and with full disks, everybody killed at random, for so many seconds (600 without a
# number):
#   tests/chaos.sh [SECONDS [SEED]]
# Every honest final model arrives once, byte for byte, nothing of the attacker counts, and what the ground holds of memory, files,
# descriptors and threads is bounded.
set -euo pipefail
cd "$(dirname "$0")/.."
export DGTR_CHAOS_S=${1:-600} DGTR_CHAOS_SEED=${2:-1}
exec cargo test --release --locked --workspace --features "${DGTR_FEATURES:-hal/v4l2}" --lib after_the_chaos -- --nocapture
