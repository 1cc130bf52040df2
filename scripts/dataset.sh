#!/usr/bin/env bash
# Records the demonstrations of all 24 tasks: workers stream expert episodes to the trainer's service, which keeps each as
# an MCAP file. An interrupted run is simply run again. Everything is read and checked at the end.
set -euo pipefail
cd "$(dirname "$0")/.."

episodes=${EPISODES:-100}
dataset=data/demonstrations
endpoint=tcp/127.0.0.1:$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')

mkdir -p runs
target/release/cpn-trainer serve --dataset "$dataset" --listen "$endpoint" 2>runs/recorder.log &
recorder=$!
trap 'kill $recorder 2>/dev/null || true; wait' EXIT
"$CPN_SIM_WORKER" demonstrate --episodes "$episodes" --connect "$endpoint"
target/release/cpn-trainer verify --dataset "$dataset" --episodes "$episodes"
