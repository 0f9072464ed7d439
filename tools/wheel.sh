#!/usr/bin/env bash
# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
# Builds the source distribution, of it a wheel for every Python 3.10 … 3.13 that is there, on the PATH or from
# pyenv, and uses each without ROS in a fresh environment. Says which were tried and which are missing.
# Usage: tools/wheel.sh [3.12 …]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONPATH AMENT_PREFIX_PATH PYTHONHOME
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

find_python() { # find_python VERSION: its path, or nothing
  local own
  for own in "$HOME/.pyenv/versions/$1".*/bin/python "$(command -v "python$1" || true)"; do
    if [ -x "$own" ] && "$own" -c 'import ensurepip, venv' 2>/dev/null; then echo "$own"; return; fi
  done
}

use() { # use FOLDER: what a user does first, with the files that the wheel brought
  cd "$1"
  unset VIRTUAL_ENV
  local run=$1/bin/calib-planner
  "$1/bin/python" -c 'import calib_planner, sys; assert "rclpy" not in sys.modules; print(calib_planner.__version__)' >/dev/null
  "$run" robots list >/dev/null
  "$run" plan --robot kuka_kr270 --test-pose "0 -1.05 1.57 0 0.79 0" --configurations 3 --starts 2 --error-model paper \
    --output plan.yaml --sheet sheet >/dev/null 2>&1
  "$run" simulate --robot kuka_kr270 --plan plan.yaml --error-model paper --output points.csv >/dev/null
  "$run" identify --robot kuka_kr270 --data points.csv --error-model paper --report report.html >/dev/null
  "$run" program plan.yaml --for krl --output visits.src >/dev/null
  test -s sheet/plan_sheet.html && test -s report.html && test -s visits.src
}

mkdir "$work/source" # a copy: an older build/ would end in the distributions
git ls-files -co --exclude-standard -z | tar --null -T - -c | tar -x -C "$work/source"
missing=()
for one in ${*:-3.10 3.11 3.12 3.13}; do
  python=$(find_python "$one")
  if [ -z "$python" ]; then missing+=("$one"); continue; fi
  "$python" -m venv "$work/$one"
  if [ ! -d "$work/sdist" ]; then
    "$python" -m venv "$work/build"
    "$work/build/bin/pip" --disable-pip-version-check install -q build
    "$work/build/bin/python" -m build --sdist --outdir "$work/sdist" "$work/source" >/dev/null
  fi
  "$work/$one/bin/pip" --disable-pip-version-check wheel -q --no-deps -w "$work/wheels-$one" "$work"/sdist/*.tar.gz
  "$work/$one/bin/pip" --disable-pip-version-check install -q "$work/wheels-$one"/*.whl
  (use "$work/$one")
  echo "wheel of the source distribution: Python $one plans, identifies and writes its pages without ROS"
done
if [ ${#missing[@]} -gt 0 ]; then echo "wheel: not on this machine, not tried: Python ${missing[*]}"; fi
