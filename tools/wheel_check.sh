#!/bin/sh
# Builds the wheel and installs it in a clean environment. Without any extra: the command's help, and the five
# lines of docs/library.md on simulated photos. With extras: a lens report, and what the commands that are no part
# of the wheel say. Nothing of the source tree is on the path; of its files, the page and photographs are read.
#
#     tools/wheel_check.sh [PYTHON]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
trap 'exit 1' HUP INT TERM
# One environment, nothing kept besides it: packages of this size fill the disk of a small machine
export TMPDIR="$work" PIP_NO_CACHE_DIR=1
install() { pip install --quiet --no-compile "$@"; }

"${1:-python3}" -m venv "$work/venv"
export PATH="$work/venv/bin:$PATH"
pip wheel --quiet --no-deps --wheel-dir "$work" "$here" # in an environment that pip makes and removes
wheel=$(ls "$work"/lensmodel-*.whl)
size=$(stat -c %s "$wheel")
echo "wheel: $(basename "$wheel"), $size bytes"
test "$size" -lt 12000000 || { echo "the wheel is larger than 12 MB, most of it weights: what came in?"; exit 1; }

cd "$work"
unset PYTHONPATH
install "$wheel"
python -m lensmodel --help >/dev/null
lensmodel calibrate --help >/dev/null
mkdir five-lines
(cd five-lines && python - "$here" <<'PYTHON'
import re
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import lensmodel
from lensmodel.core.types import LensSettings
from lensmodel.simulate import SimulatedCamera, draw_lens, load_scene, photograph, write_photo

assert "site-packages" in lensmodel.__file__, lensmodel.__file__
extras = [name for name in ("fastapi", "sqlalchemy", "sklearn", "matplotlib") if find_spec(name)]
assert not extras, extras
source = Path(sys.argv[1])
camera = SimulatedCamera(height=384, width=576, pitch_um=9.0)
true_lens = draw_lens(5, "soft-fast")
settings = LensSettings(aperture=true_lens.at_focal().f_number)
for seed, (name, scene, left) in enumerate([("a", "tea-gardens", 400), ("b", "lake", 400), ("c", "city", 500)]):
    whole = load_scene(source / "lensmodel" / "demo_data" / f"{scene}.jpg")
    cut = np.ascontiguousarray(whole[:, 200 : 200 + camera.height + 32, left : left + camera.width + 32])
    shot = photograph(cut, true_lens, settings, camera, np.random.default_rng(seed), size=41, step=0.3)
    write_photo(Path(f"{name}.dng"), shot)

lines = re.search(r"```python\n(.*?)```", (source / "docs" / "library.md").read_text(encoding="utf-8"), re.DOTALL)
names = {}
exec(compile(lines.group(1), "docs/library.md", "exec"), names)  # its calibrate starts processes by itself
assert names["kernel"].shape == (55, 55) and abs(names["kernel"].sum() - 1.0) < 1e-9
assert names["photo"].planes.shape == (3, camera.height, camera.width)
assert sorted(names["lens"].photos.values()) == ["a.dng", "b.dng"]
assert lensmodel.Lens.load("my-24mm.lensprofile").samples and Path("c.tif").exists()
PYTHON
)
echo "without extras: the help, and the five lines of the library"

install "$wheel[report,fits]"
lensmodel --version
python - <<'PYTHON'
from importlib.metadata import files
from importlib.util import find_spec

import numpy as np

import lensmodel

assert {file.parts[0] for file in files("lensmodel")} <= {"lensmodel", "..", *(
    file.parts[0] for file in files("lensmodel") if file.parts[0].endswith(".dist-info")
)}
assert find_spec("app") is None and find_spec("migrations") is None
assert any(str(file) == "lensmodel/py.typed" for file in files("lensmodel"))
offsets = np.arange(15) - 7.0
spot = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2))
lens = lensmodel.Lens.from_kernels([spot] * 12, np.linspace(0.1, 0.9, 12), np.linspace(-3, 3, 12), aperture=2.0)
lens.save("test.lensprofile")
planes = np.random.default_rng(0).random((3, 64, 96), dtype=np.float32)
assert lensmodel.correct(planes, "test.lensprofile", aperture=2.0, method="fast").planes.shape == planes.shape
PYTHON
lensmodel export test.lensprofile --rows 1 --cols 1 --output psf.npz
test -s psf.npz
lensmodel report test.lensprofile --output report
test -s report/report.pdf
for command in serve demo "bench model"; do
  lensmodel $command 2>&1 | grep -q "source tree" || { echo "$command: does not say where it runs"; exit 1; }
done
echo "the wheel works"
