#!/usr/bin/env bash
# PETSc, MPI, DOLFINx and livepde on a fresh Debian 12 (as root): deploy/petsc.sh [FOLDER [PACKAGE]]
#
# FOLDER is the environment to make, default .venv-petsc; PACKAGE is what pip is to install: a folder,
# default this project, or a name. Then:
# mpirun -n 4 FOLDER/bin/python -m mpi4py examples/petsc_heat.py
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
folder="${1:-.venv-petsc}"
package="${2:-$here}"

needed=(python3-petsc4py python3-petsc4py-real python3-dolfinx python3-dolfinx-real python3-mpi4py)
needed+=(python3-venv openmpi-bin)
missing=()
for name in "${needed[@]}"; do
  dpkg-query --show --showformat='${db:Status-Abbrev}' "$name" 2>/dev/null | grep -q '^ii' \
    || missing+=("$name")
done
if [[ ${#missing[@]} -gt 0 ]]; then
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}"
fi

# Debian's petsc4py was built with NumPy 1; everything else may be as new as that allows.
/usr/bin/python3 -m venv --clear --system-site-packages "$folder"
[[ -d "$package" ]] && package="--editable=$package"
"$folder/bin/python" -m pip --disable-pip-version-check --quiet install "numpy<2" "$package"

# Where Debian keeps petsc4py: found from now on without PETSC_DIR.
shopt -s nullglob
found=(/usr/lib/petscdir/petsc*/*-real/lib/python3/dist-packages)
[[ ${#found[@]} -gt 0 ]] || { echo "Found no petsc4py of Debian's." >&2; exit 1; }
site="$("$folder/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
echo "${found[-1]}" > "$site/debian-petsc.pth"
"$folder/bin/python" -c 'from dolfinx import __version__ as dolfinx; from petsc4py import PETSc; print("DOLFINx", dolfinx, "PETSc", *PETSc.Sys.getVersion(), "in", "'"$folder"'")'
