#!/usr/bin/env bash
# Set up `.venv` with the command `hybridmap` and the tools for developers. The script may be run again at any time; it does
# only what is missing. It needs Python >= 3.11 with venv. It also installs the system libraries that open3d needs, on
# Debian and Ubuntu, if it has root or sudo without a password.
#
#   tools/setup.sh                           use the first suitable Python on the PATH
#   PYTHON=/path/to/python tools/setup.sh    use this Python
set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
venv="$root/.venv"
stamp="$venv/.setup-stamp"

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "error: $*"; exit 1; }

# Only one setup runs at a time. A second one waits.
if command -v flock >/dev/null; then
  exec 9<"$root/pyproject.toml"
  flock 9
fi

# An interrupted run may leave a folder that is no virtual environment, or one without pip. Such a folder is made anew.
usable_venv() {
  "$venv/bin/python" -c 'import importlib.util as u, sys
sys.exit(sys.prefix == sys.base_prefix or sys.version_info < (3, 11) or u.find_spec("pip") is None)' >/dev/null 2>&1
}

suits() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

find_python() {
  local candidate
  if [[ -n "${PYTHON:-}" ]]; then
    suits "$PYTHON" || die "PYTHON=$PYTHON does not run or is too old ($("$PYTHON" --version 2>&1 || true)); Python 3.11 or newer is needed"
    printf '%s' "$PYTHON"
    return
  fi
  for candidate in python3.11 python3.12 python3.13 python3 python; do
    if command -v "$candidate" >/dev/null && suits "$candidate"; then
      printf '%s' "$candidate"
      return
    fi
  done
  die "no Python 3.11 or newer on the PATH (python3 is $(python3 --version 2>&1 || echo missing)); install one" \
    "(Debian 12, Ubuntu: apt-get install python3.11 python3.11-venv) or name it: make setup PYTHON=/path/to/python"
}

create_venv() {
  local python
  python="$(find_python)"
  "$python" -c 'import ensurepip, venv' 2>/dev/null ||
    die "$python has no venv module; install it (Debian, Ubuntu: apt-get install python3-venv)"
  say "creating .venv with $("$python" --version)"
  rm -rf "$venv"
  "$python" -m venv "$venv" || die "$python could not create $venv (see above)"
}

# Everything that the installed packages depend on: the declared dependencies, the tested versions, the Python version, and the path of the
# checkout, because an editable install and the shebangs hold absolute paths.
fingerprint() {
  "$venv/bin/python" - "$root" <<'PY'
import hashlib, pathlib, sys
root = pathlib.Path(sys.argv[1])
declared = (root / "pyproject.toml").read_bytes() + (root / "constraints.txt").read_bytes()
print(hashlib.sha256(declared).hexdigest(), sys.version.split()[0], root)
PY
}

installed() {
  [[ -x "$venv/bin/hybridmap" && -x "$venv/bin/pytest" && -f "$stamp" ]] && [[ "$(cat "$stamp")" == "$(fingerprint)" ]]
}

install_packages() {
  say "installing hybridmap and its dependencies into .venv (a minute or two, 2 GB on disk)"
  rm -f "$stamp"
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --retries 5 \
    --constraint "$root/constraints.txt" --editable "$root[dev]" ||
    die "pip could not install the dependencies (see above); run it again once the cause is gone. Where a version of" \
      "constraints.txt does not exist for this Python, take that line out"
}

package_of() {
  case "$1" in
    libEGL.so.1) echo libegl1 ;;
    libGL.so.1) echo libgl1 ;;
    libX11.so.6) echo libx11-6 ;;
    libgcc_s.so.1) echo libgcc-s1 ;;
    libgomp.so.1) echo libgomp1 ;;
    libidn2.so.0) echo libidn2-0 ;;
    libstdc++.so.6) echo libstdc++6 ;;
    libudev.so.1) echo libudev1 ;;
    libusb-1.0.so.0) echo libusb-1.0-0 ;;
    *) echo "?" ;;
  esac
}

# Print the shared libraries that the loader cannot find. The plug-ins of open3d for torch and tensorflow are not used.
missing_libraries() {
  command -v ldd >/dev/null || return 0
  local library
  for library in "$venv"/lib/python3.*/site-packages/open3d/{libOpen3D.so*,pybind*.so} \
    "$venv"/lib/python3.*/site-packages/cv2/cv2*.so; do
    [[ -f "$library" ]] && ldd "$library" 2>/dev/null
  done | awk '$2 == "=>" && $3 == "not" { print $1 }' | grep -v '^libOpen3D' | sort -u || true
}

as_root() {
  if [[ "$(id -u)" == 0 ]]; then "$@"; else sudo -n "$@"; fi
}

can_apt() {
  command -v apt-get >/dev/null && { [[ "$(id -u)" == 0 ]] || { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }; }
}

install_libraries() {
  local missing packages=() unknown=() soname package
  missing="$(missing_libraries)"
  [[ -z "$missing" ]] && return 0
  for soname in $missing; do
    package="$(package_of "$soname")"
    if [[ "$package" == "?" ]]; then unknown+=("$soname"); else packages+=("$package"); fi
  done
  if ((${#packages[@]})) && can_apt; then
    say "installing system libraries: ${packages[*]}"
    as_root apt-get update -qq || say "apt-get update failed; trying with the lists at hand"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${packages[@]}" >/dev/null ||
      say "apt-get install failed (see above)"
    missing="$(missing_libraries)"
    [[ -z "$missing" ]] && return 0
  fi
  say "error: open3d needs shared libraries that this machine does not have:" $missing
  ((${#packages[@]})) && say "  Debian, Ubuntu: ask for  apt-get install ${packages[*]}"
  ((${#packages[@]})) && say "  conda, no root: conda install -c conda-forge libusb libgl libegl xorg-libx11 libudev libidn2," \
    "and put its lib folder on LD_LIBRARY_PATH"
  ((${#unknown[@]})) && say "  no package is known for ${unknown[*]}: look it up with  apt-file search <name>"
  say "  then run  make setup  again: what is done already is kept"
  return 1
}

usable_venv || create_venv
fresh=0
if ! installed; then
  install_packages
  fresh=1
fi
install_libraries || exit 1
if ((fresh)); then
  "$venv/bin/python" -c 'import cv2, gtsam, open3d' || die "a dependency cannot be imported (see above)"
  "$venv/bin/hybridmap" --version >/dev/null || die "the command .venv/bin/hybridmap does not start (see above)"
  fingerprint >"$stamp"
  say "done: $venv/bin/hybridmap"
fi
