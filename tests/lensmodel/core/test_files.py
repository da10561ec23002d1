"""Files that say why they could not be written."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lensmodel.core.files import atomic, replacing, save_array, write_atomically


@given(
    st.one_of(
        *(
            arrays.arrays(dtype, arrays.array_shapes(min_side=0))
            for dtype in (np.float32, np.float64, np.uint16)
        )
    )
)
def test_an_array_reads_back_as_numpy_wrote_it(array: np.ndarray) -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    save_array(ours, array)
    np.save(theirs, array, allow_pickle=False)

    assert ours.getvalue() == theirs.getvalue()


def test_an_array_in_another_order_is_the_same_array(tmp_path: Path) -> None:
    array = np.asfortranarray(np.arange(24.0).reshape(2, 3, 4))
    with (tmp_path / "a.npy").open("wb") as file:
        save_array(file, array[:, ::-1])

    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), array[:, ::-1])


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_what_a_file_has_no_room_for_is_told_with_its_number(tmp_path: Path) -> None:
    program = """
import errno, resource, signal, sys
import numpy as np
from lensmodel.core.files import save_array
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    with open(sys.argv[1], "wb") as file:
        save_array(file, np.ones((100, 100)))
except OSError as error:
    sys.exit(0 if error.errno == errno.EFBIG else repr(error))
sys.exit("nothing was raised")
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.npy")], capture_output=True, check=False
    )

    assert (done.returncode, done.stderr) == (0, b"")


def test_a_file_is_replaced_whole_or_left_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.tar.txt"
    write_atomically(path, b"first")
    with pytest.raises(TypeError), atomic(path) as file:
        file.write("no bytes")  # type: ignore[arg-type]

    assert path.read_bytes() == b"first"
    with replacing(path) as part:
        part.write_bytes(b"second")
        assert (part.parent, part.suffix) == (tmp_path, ".txt")
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]
