"""`lensmodel correct --server URL`: the same work, done by a service elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.progress import Progress, TaskID

from lensmodel.api import FORMATS
from lensmodel.cli import files, outputs
from lensmodel.cli.console import Display, gain_words
from lensmodel.cli.ending import UsageError
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import ZONE_WORDS

if TYPE_CHECKING:
    from app.client import Client
    from app.schemas import JobOut

AUTO = "auto"


def run(
    names: Sequence[str],
    url: str,
    lens: str,
    output: str | None,
    options: outputs.CorrectionOptions,
    display: Display,
    *,
    as_json: bool,
) -> None:
    """Send photos to a service, have it learn their lenses and correct them, and fetch the results.

    Parameters
    ----------
    names : sequence of str
        Photos, folders or patterns.
    url : str
        Where the service listens; its key is LENS_API_KEY of the environment.
    lens : str
        "auto": learn from these photos too; else the id of a lens of the service.
    output, options, display, as_json
        As of `lensmodel.cli.correct`.
    """
    import httpx2  # noqa: PLC0415 - an extra: the commands on files do without it

    from app.client import Client  # noqa: PLC0415 - same

    targets, twice = outputs.targets_of(files.photos(names), output, options.file_format)
    results = outputs.clashes(twice, display)
    try:
        with Client(url) as client, display.progress() as bars:
            work = _Remote(client, lens, options, display)
            task = bars.add_task("sending", total=len(targets))
            sent = {}
            for number, (target, path) in enumerate(targets.items()):
                bars.update(task, description=f"sending {path.name}", completed=number)
                sent[target] = work.sent(path, target)
            bars.remove_task(task)
            task = bars.add_task("waiting", total=len(targets))
            for number, (target, path) in enumerate(targets.items()):
                result = work.result(path, target, sent[target], partial(_show, bars, task, number))
                work.say(path, target, result, as_json=as_json)
                results.append({"photo": str(path), "output": str(target), **result})
                bars.update(task, completed=number + 1)
    except httpx2.TransportError as error:
        raise UsageError(f"--server {url}: no service answers there ({error})") from error
    except httpx2.InvalidURL as error:
        raise UsageError(f"--server {url}: {error}; give an address such as http://host:8000") from error
    if as_json:
        display.document({"server": url, "results": results})
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


class _Remote:
    """The requests to the service, photo by photo."""

    def __init__(
        self, client: Client, lens: str, options: outputs.CorrectionOptions, display: Display
    ) -> None:
        self._client, self._options, self._display = client, options, display
        self._lens = None if lens == AUTO else lens

    def sent(self, path: Path, target: Path) -> dict[str, Any] | str:
        """Send a photo; return its id, or its result if it is not sent."""
        if target.exists() and not self._options.force:
            return {"state": "kept"}
        try:
            return self._client.upload(
                path, calibrate=self._lens is None, lens_id=self._lens, aperture=self._options.aperture
            ).id
        except (LensModelError, OSError) as error:
            return files.failed(error)

    def result(
        self,
        path: Path,
        target: Path,
        sent: dict[str, Any] | str,
        on_change: Any,  # noqa: ANN401 - a partial
    ) -> dict[str, Any]:
        """Wait for a photo, have it corrected, and fetch the result."""
        from app.client import JobEndedError  # noqa: PLC0415 - as above

        if not isinstance(sent, str):
            return sent
        try:
            try:
                self._client.wait(sent, on_change=partial(on_change, f"learning from {path.name}"))
            except JobEndedError as ended:
                if ended.job.state == "waiting":
                    raise
                # it taught nothing; other photos may have, and it may be corrected all the same
                self._display.detail(f"{path}: {ended}")
            wanted = self._client.correct(sent, **self._request(target))
            self._client.wait(wanted, on_change=partial(on_change, f"correcting {path.name}"))
            report = self._client.correction(wanted.id).report or {}
            if report.get("nothing_to_correct"):
                return {"state": "left", "reason": "nothing to correct"}
            target.parent.mkdir(parents=True, exist_ok=True)
            self._client.download(wanted.id, target)
        except (LensModelError, OSError) as error:
            return files.failed(error)
        return {"state": "corrected", "lens_id": wanted.lens_id, "report": report}

    def _request(self, target: Path) -> dict[str, Any]:
        bounds = self._options.bounds
        request = {
            "method": self._options.method or "standard",
            "strength": self._options.strength,
            "texture": bounds.texture,
            "denoise": bounds.denoise,
            "output": {"format": self._options.file_format or FORMATS[target.suffix.lower()]},
        }
        if bounds.halo is not None and math.isfinite(bounds.halo):
            request["halo"] = bounds.halo
        return request if self._lens is None else {**request, "lens_id": self._lens}

    def say(self, path: Path, target: Path, result: dict[str, Any], *, as_json: bool) -> None:
        """Print the result of a photo."""
        if result["state"] == "failed":
            self._display.error(f"{path}: {result['reason']}")
        elif result["state"] == "kept":
            self._display.note(f"{target} is there already and was left alone; --force replaces it")
        elif result["state"] == "left":
            self._display.note(f"{path}: left as it is, {result['reason']}")
        elif not as_json:
            self._display.result(str(target))
        if result["state"] == "corrected":
            zones = result["report"].get("zones", {})
            gains = (
                f"{word} {gain_words(zones[zone].get('expected_gain_db'))}"
                for zone, word in ZONE_WORDS.items()
                if zone in zones
            )
            self._display.detail(f"{path.name}, expected gain: {', '.join(gains)}")


def _show(bars: Progress, task: TaskID, number: int, words: str, job: JobOut) -> None:
    share = job.progress.done / job.progress.total if job.progress and job.progress.total else 0.0
    bars.update(task, description=words, completed=number + min(share, 1.0))
