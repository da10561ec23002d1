import numpy as np
import pytest

from lab.correction.correction_benchmark import correct_table, run_correct_benchmark
from lab.peers import Peer
from lensmodel.core.errors import InvalidInputError


@pytest.mark.slow  # the next one corrects the same photo, a part of it
def test_benchmark_times_each_method_and_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    photo = np.full((3, 210, 220), 0.3, dtype=np.float32)

    missing = Peer("nobody's", "no-such-program", lambda *_: [], (1.0,), 1.0)

    report = run_correct_benchmark(photo, methods=("fast",), repeats=2, peers=[missing])

    assert report["methods"]["fast"]["cpu_s"] > 0
    assert report["kernel"]["ours"] > 0
    assert report["peers"] == {"nobody's": None}
    assert "| nobody's | not installed |" in correct_table(report)
    assert capsys.readouterr().out == ""


def test_benchmark_of_a_window_counts_its_pixels_only() -> None:
    photo = np.full((3, 210, 220), 0.3, dtype=np.float32)

    report = run_correct_benchmark(photo, methods=("fast",), roi=(0, 0, 100, 110), cfa=((0, 1), (1, 2)))

    assert report["raw"]
    assert "RAW" in correct_table(report)
    assert report["megapixels"] == pytest.approx(0.011)
    with pytest.raises(InvalidInputError, match="does not lie"):
        run_correct_benchmark(photo, methods=("fast",), roi=(150, 0, 100, 110))
