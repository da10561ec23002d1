"""What the demo measured, as a page for people and as JSON for programs."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from lab.demo.measure import Sharpness, improved
from lensmodel.cli.console import mtf50_words
from lensmodel.core.types import ZONES, Zone

_JUDGED: tuple[Zone, ...] = ("center", "corner")


@dataclass(slots=True)
class DemoReport:
    """Filled in as the demo goes; one entry of a list for each photo that the lens has learned from."""

    lens: str
    aperture: float
    psf_error: list[dict[Zone, float]] = field(default_factory=list)
    psnr_before: dict[Zone, float] = field(default_factory=dict)
    psnr_after: list[dict[Zone, float]] = field(default_factory=list)
    chart_before: dict[Zone, Sharpness] = field(default_factory=dict)
    chart_after: dict[Zone, Sharpness] = field(default_factory=dict)
    answers: list[tuple[float, float, int, float | None]] = field(default_factory=list)
    refusal: str = ""
    estimator: str = "default"
    seconds: float = 0.0

    @property
    def improved(self) -> bool:
        """Whether the photo never used for calibration has become better in centre and corner."""
        return bool(self.psnr_after) and improved(self.psnr_before, self.psnr_after[-1], _JUDGED)

    def write(self, folder: Path) -> None:
        """Write report.md and report.json."""
        stored = {**asdict(self), "improved": self.improved}
        (folder / "report.json").write_text(json.dumps(stored, indent=2, default=str), encoding="utf-8")
        (folder / "report.md").write_text("\n".join(self._lines()) + "\n", encoding="utf-8")

    def _lines(self) -> list[str]:
        verdict = "better" if self.improved else "NOT better"
        lines = [
            "# What the demo measured",
            "",
            f"Lens: {self.lens}, at f/{self.aperture:g}, simulated, so that the truth is known. The photo "
            f"that it was never calibrated with became **{verdict}** in centre and corner. "
            f"Blind estimator: {self.estimator}.",
            "",
            "| photos learned from | PSF error centre / mid / corner | PSNR centre / mid / corner (dB) |",
            "| --- | --- | --- |",
            f"| 0, the photo as it was | | {_row(self.psnr_before, 2)} |",
        ]
        lines += [
            f"| {number} | {_row(error, 2)} | {_row(after, 2)} |"
            for number, (error, after) in enumerate(
                zip(self.psf_error, self.psnr_after, strict=True), start=1
            )
        ]
        lines += [
            "",
            "PSF error: relative L2 distance to the true green PSF after sub-pixel alignment, median of the "
            "zone; 0 is perfect. PSNR: sRGB-encoded picture against the sharp scene, each block of 128 "
            "pixels at "
            "its best shift, before and after alike: a PSF's centre of mass may lie beside its core, which "
            "displaces the picture smoothly but does not blur it.",
            "",
            "| slanted edges of a chart | MTF50 before | MTF50 after | highest MTF after | overshoot after |",
            "| --- | --- | --- | --- | --- |",
        ]
        for zone in ZONES:
            if zone in self.chart_before and zone in self.chart_after:
                before, after = self.chart_before[zone], self.chart_after[zone]
                lines.append(
                    f"| {zone} | {mtf50_words(before.mtf50)} | {mtf50_words(after.mtf50)} "
                    f"| {after.mtf_max:.2f} | {after.overshoot:.1f} % |"
                )
        lines += [
            "",
            "MTF50 in cycles/pixel, green. A PSF that is too wide raises MTF50 as well, but then the highest "
            "MTF rises above 1 and edges overshoot: read them together.",
            "",
            "| r (phi = 0.6) | effective samples | photos | predicted PSF error |",
            "| --- | --- | --- | --- |",
        ]
        for r, samples, photos, error in self.answers:
            lines.append(f"| {r:g} | {samples:.1f} | {photos} | {'' if error is None else f'{error:.2f}'} |")
        lines += [
            "",
            "## A photo that shows too little",
            "",
            "One RAW file of a Canon EOS Kiss X4: a chart of even patches before a background out of focus. "
            f"{self._refused()}",
            "",
            f"The whole demo took {self.seconds:.0f} s.",
            "",
            "Files: corrected.tif (16 bit), before-after.png, psf-field.png, calibration-history.svg and "
            ".json, report.json, service.log.",
        ]
        return lines

    def _refused(self) -> str:
        if not self.refusal:
            return "The service learned from it."
        return f"The service does not learn a lens from it: {self.refusal}"


def _row(values: dict[Zone, float], digits: int) -> str:
    return " / ".join(f"{values[zone]:.{digits}f}" for zone in ZONES)
