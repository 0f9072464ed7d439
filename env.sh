# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
# Source this file (bash or zsh, from any folder) for a shell in which python, calib-planner and the
# nodes of this checkout run. Prepared by `make setup`.

if [ -n "${BASH_SOURCE:-}" ]; then
  _cp_root=$(cd "$(dirname "${BASH_SOURCE[0]}")" >/dev/null && pwd -P)
else
  _cp_root=$(cd "$(dirname "${(%):-%x}")" >/dev/null && pwd -P)
fi

_cp_prepend() { # _cp_prepend VARIABLE FOLDER: once, in front
  eval "_cp_old=\"\${$1:-}\""
  case ":$_cp_old:" in
    *":$2:"*) ;;
    *) export "$1=$2${_cp_old:+:$_cp_old}" ;;
  esac
}

_cp_enter() {
  export VIRTUAL_ENV="$_cp_root/.venv"
  if [ "$_cp_ros_from" = wheels ]; then
    _cp_prepend AMENT_PREFIX_PATH "$VIRTUAL_ENV"
    _cp_prepend CMAKE_PREFIX_PATH "$VIRTUAL_ENV"
    export ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy
  elif [ -z "${AMENT_PREFIX_PATH:-}" ]; then
    if [ -n "${ZSH_VERSION:-}" ]; then . "$_cp_ros_setup.zsh"; else . "$_cp_ros_setup.bash"; fi
  fi
  _cp_msgs=$_cp_root/install/calib_planner_msgs
  for _cp_prefix in "$_cp_msgs" "$_cp_root/install/calib_planner"; do
    _cp_prepend AMENT_PREFIX_PATH "$_cp_prefix"
    _cp_prepend CMAKE_PREFIX_PATH "$_cp_prefix"
  done
  _cp_prepend LD_LIBRARY_PATH "$_cp_msgs/lib"
  _cp_prepend PYTHONPATH "$_cp_msgs/lib/python$_cp_python/site-packages"
  _cp_prepend PATH "$VIRTUAL_ENV/bin"
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
  unset PYTHONHOME
  hash -r 2>/dev/null || true
}

_cp_status=1
if [ -f "$_cp_root/.venv/set-up.sh" ] && [ -f "$_cp_root/install/.stamp-package" ]; then
  . "$_cp_root/.venv/set-up.sh"
  if [ "${_cp_made_in:-$_cp_root}" = "$_cp_root" ]; then
    _cp_enter
    _cp_status=0
  else
    echo "env.sh: this folder was set up as '$_cp_made_in' and has moved since; run: make -C '$_cp_root' setup" >&2
  fi
else
  echo "env.sh: not set up yet; run: make -C '$_cp_root' setup" >&2
fi
unset -f _cp_enter _cp_prepend
unset _cp_root _cp_made_in _cp_old _cp_msgs _cp_prefix _cp_ros_from _cp_ros_setup _cp_python
# The last command is the file's status; it also forgets the last name.
eval "unset _cp_status; [ $_cp_status = 0 ]"
