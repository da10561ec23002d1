#!/bin/sh
# Builds the wheel, installs it in a clean environment with the extras of the service, and uses what a user
# uses: the command, the library, the service. Nothing of the source tree is on the path.
#
#     tools/wheel_check.sh [PYTHON]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'test -z "${service:-}" || kill "$service" 2>/dev/null; rm -rf "$work"' EXIT INT TERM
python=${1:-python3}

"$python" -m venv "$work/build"
"$work/build/bin/pip" install --quiet hatchling
(cd "$here" && "$work/build/bin/python" -m hatchling build --target wheel --directory "$work" >/dev/null)
wheel=$(ls "$work"/lensmodel-*.whl)
size=$(stat -c %s "$wheel")
echo "wheel: $(basename "$wheel"), $size bytes"
test "$size" -lt 3000000 || { echo "the wheel is larger than 3 MB: what came in?"; exit 1; }

"$python" -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "$wheel[service,fast]"
cd "$work"
unset PYTHONPATH
export PATH="$work/venv/bin:$PATH"

lensmodel --version
python -m lensmodel --help >/dev/null
python - <<'PYTHON'
import numpy as np
import lensmodel

assert "site-packages" in lensmodel.__file__, lensmodel.__file__
offsets = np.arange(15) - 7.0
spot = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2))
lens = lensmodel.Lens.from_kernels([spot] * 8, np.linspace(0.1, 0.9, 8), np.linspace(-3, 3, 8), aperture=2.0)
lens.save("test.lensprofile")
planes = np.random.default_rng(0).random((3, 64, 96), dtype=np.float32)
assert lensmodel.correct(planes, "test.lensprofile", aperture=2.0, method="fast").planes.shape == planes.shape
PYTHON
lensmodel psf test.lensprofile --r 0.5
lensmodel demo --output demo 2>&1 | grep -q "source tree" && echo "demo: says where its photographs are"

lensmodel serve --port 0 --data data >serve.log 2>&1 &
service=$!
for _ in $(seq 120); do grep -q ready serve.log && break; sleep 1; done
url=$(python -c "import json; print(json.load(open('data/service.json'))['url'])")
python - "$url" <<'PYTHON'
import sys
import urllib.request

for path in ("/healthz", "/readyz", "/v1/formats", "/", "/docs", "/openapi.json"):
    with urllib.request.urlopen(sys.argv[1] + path, timeout=30) as answer:
        assert answer.status == 200, path
        print(path, len(answer.read()), "bytes")
PYTHON
kill -TERM "$service"
wait "$service"
service=
echo "the wheel works"
