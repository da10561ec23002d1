#!/bin/sh
# Installs the lowest versions of packages that pyproject.toml allows, and runs a short part of the tests with them.
#
#     tools/lowest_check.sh [PYTHON]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
trap 'exit 1' HUP INT TERM
# Nothing is kept besides the environment: packages of this size fill the disk of a small machine
export TMPDIR="$work" PIP_NO_CACHE_DIR=1 UV_NO_CACHE=1
"${1:-python3}" -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet uv
install() { "$work/venv/bin/uv" pip install --quiet --python "$work/venv/bin/python" "$@"; }
cd "$here"
install --resolution lowest-direct --requirements pyproject.toml --extra report --extra fits
install pytest hypothesis exifread scikit-image markdown # what tests and their scenes need, of any version
"$work/venv/bin/python" -m pip list --format=freeze | grep -iE '^(numpy|scipy|numba|rawpy|tifffile|pillow|imagecodecs|matplotlib)=='
"$work/venv/bin/python" -m pytest -q -p no:cacheprovider -o filterwarnings=default \
  -m "not slow and not tools" \
  tests/lensmodel/core tests/lensmodel/quality tests/lensmodel/photo/test_write.py \
  tests/lensmodel/correction/test_blur.py tests/lensmodel/model/test_regression.py tests/lensmodel/neural \
  tests/lensmodel/report
