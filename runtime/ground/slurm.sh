#!/bin/sh
# A merge on a Slurm cluster: plan, an array of jobs for the cells, join, each after the one before.
#   STORE=/shared/field OUT=merged slurm.sh models/*.dgtr [--mission mission.toml …]
# JOBS (16): jobs of the array. DGTR: the program. CELLS: more for the array's sbatch, as in "--gres=gpu:1 --mem=4G".
set -eu
if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
    exec "$DGTR" ground cell --share "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" --store "$STORE"
fi
export STORE OUT JOBS="${JOBS:-16}" DGTR="${DGTR:-dgtr}"
quoted=$(for a in "$DGTR" ground plan "$@" --store "$STORE"; do printf "'%s' " "$a"; done)
plan=$(sbatch --parsable --job-name=dgtr-plan --wrap "$quoted")
# A job that is killed with its node is queued again, and finds what it had finished.
# shellcheck disable=SC2086
cells=$(sbatch --parsable --job-name=dgtr-cells --array="0-$((JOBS - 1))" --requeue --dependency="afterok:$plan" ${CELLS:-} "$0")
sbatch --job-name=dgtr-join --dependency="afterok:$cells" --wrap "'$DGTR' ground join --store '$STORE' --out '$OUT'"
