#!/usr/bin/env bash
# Start a Dask scheduler, workers and the driver of a fleet under SLURM: sbatch deploy/fleet/slurm.sh
#SBATCH --job-name=barsight-fleet
#SBATCH --ntasks=9
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=3G
#SBATCH --time=12:00:00
# RESULTS, STORE (PostgreSQL) and the storage's keys (AWS_ACCESS_KEY_ID, ...) come from the environment.
set -euo pipefail
: "${RESULTS:?URL of the results}" "${STORE:?URL of the store}"
address=$SLURM_SUBMIT_DIR/scheduler-$SLURM_JOB_ID.json
dask scheduler --scheduler-file "$address" --no-dashboard &
until [ -s "$address" ]; do sleep 1; done
srun --ntasks="$((SLURM_NTASKS - 1))" dask worker --scheduler-file "$address" --nthreads 1 --no-dashboard \
    --memory-limit 0 --death-timeout 120 &
uri=$(python -c "import json, sys; print(json.load(open(sys.argv[1]))['address'])" "$address")
barsight fleet run --results "$RESULTS" --store "$STORE" --scheduler "$uri" --memory-gib 10 \
    --threads "$SLURM_CPUS_PER_TASK"
