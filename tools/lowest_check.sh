#!/bin/sh
# Installs the lowest versions of packages that pyproject.toml allows, and runs a short part of the tests with them.
#
#     tools/lowest_check.sh [PYTHON]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT INT TERM
"${1:-python3}" -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet uv
install() { "$work/venv/bin/uv" pip install --quiet --python "$work/venv/bin/python" "$@"; }
(cd "$here" && install --resolution lowest-direct '.[report,fits]')
install pytest hypothesis exifread scikit-image markdown # what tests and their scenes need, of any version
"$work/venv/bin/pip" uninstall --quiet --yes lensmodel
cd "$here"
"$work/venv/bin/python" -m pip list --format=freeze | grep -iE '^(numpy|scipy|numba|rawpy|tifffile|pillow|imagecodecs|matplotlib)=='
"$work/venv/bin/python" -m pytest -q -p no:cacheprovider -o filterwarnings=default \
  -m "not slow and not tools" \
  tests/lensmodel/core tests/lensmodel/quality tests/lensmodel/photo/test_dng.py tests/lensmodel/photo/test_write.py \
  tests/lensmodel/correction/test_blur.py tests/lensmodel/model/test_regression.py tests/lensmodel/neural \
  tests/lensmodel/report
