#!/usr/bin/env bash
# The whole loop in a new town, by commands alone: from its map (OpenDRIVE) to the plan of the next training.
#
#   examples/07_the_loop.sh [MAP.xodr [FOLDER]]
#
# SCENES and STEPS say how much is recorded and trained; docs/loop.md tells what each command gives. Wants the extra
# `towns` (netconvert), which `make` installs.
set -euo pipefail
map=$(realpath "${1:-$(dirname "$0")/../recipes/maps/quarter.xodr}")
scenes=${SCENES:-6} steps=${STEPS:-70}
mkdir -p "${2:-out/loop}" && cd "${2:-out/loop}"

echo "== A town from the map"
flcav towns import "$map" --out mine

echo "== A drive through it, a network, and what it misses and invents on another drive"
drive() { echo "{town: mine, seed: $1, scenes: $2, spins_per_scene: 4, every_s: 4.0, cavs: 3}" > "$3.yaml"; }
drive 11 "$scenes" learn
drive 12 $((scenes / 2 + 1)) look
flcav record learn.yaml --out data/learn
flcav record look.yaml --out data/look
flcav train objects --data data/learn --epochs $((steps / 12 + 1)) --out network
flcav errors objects --weights network/weights.safetensors --data data/look --out errors.csv --map errors.png

echo "== Where a roadside sensor would help most"
flcav towns show mine --poles poles.csv
flcav place --errors errors.csv --poles poles.csv --range 40 --count 1 --town mine --map placed.png

echo "== Pretraining in another town, edge FL here and there, cloud FL over both"
cat > run.yaml << YAML
seed: 3
retrainings: 2
retrain_from: edge
primary_claims: [edge]
splits:
  pool: {scenes: $scenes, spins: 4, cavs: 4}
  validation: {scenes: $((scenes / 2 + 1)), spins: 2, cavs: 3}
  registry: {scenes: 1, spins: 2, cavs: 3}
  edge: {scenes: $scenes, spins: 3, cavs: 3}
  test: {scenes: $((scenes * 2 + 1)), spins: 1, cavs: 3}
training: {steps: $((steps * 8)), local_steps: $((steps / 3 + 1)), local_rate: 1.0, start_share: 0}
tasks:
  objects: {labels: road+tracks, plan: {samples: $((scenes * 12)), edge_rounds: 5, cloud_rounds: 1}}
regions:
  suburb: {role: pretrain}
  mine: {role: federate}
  ring: {role: federate}
budgets_mb: {wireless: 200, wireline: 100}
placement: {count: 1, range_m: 40, group_range_m: 100}
federation: {upload: {compression: int8}, download: int8}
YAML
flcav run run.yaml --out run --json > run.json
echo "$PWD/run/report.html: the report"

echo "== What this run teaches the next: learning curves, and a plan by them under both budgets"
weighs() { python3 -c "import json; print(json.load(open('run.json'))['arms']['main']['plan']['tasks']['objects']['$1'])"; }
cat > problem.yaml << YAML
budgets_mb: {wireless: $((scenes * 5 + 5)), wireline: $((scenes * 5 + 3))}
tasks:
  - name: objects
    sample_mb: $(weighs sample_mb)
    model_mb: $(weighs model_mb)
    edge_groups: [2, 2]
YAML
flcav fit run/history.csv --problem problem.yaml
flcav allocate problem.yaml --baseline equal-stages --out plan.html
