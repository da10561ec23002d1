"""The client of the service for asyncio: the calls of `app.client.Client`, to be awaited.

async with AsyncClient("http://127.0.0.1:8000") as client:
    photos = await asyncio.gather(*(client.upload(path) for path in Path("holiday").glob("*.dng")))
    await asyncio.gather(*(client.wait(photo) for photo in photos))
    (lens,) = await client.lenses()

Each call runs in a thread, so that there is one client to be trusted and not two: parameters, results and
errors are those of `Client`, where they are described.
"""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Concatenate, Final, ParamSpec, Self, TypeVar

import httpx2

from app import schemas as s
from app.client import DEFAULT_URL, Client, JobPatienceError, ended
from app.client_retries import RETRIES

P = ParamSpec("P")
T = TypeVar("T")

POLL_SECONDS: Final = 2.0
"""Longest wait of one request for a job (chosen): the thread of a cancelled task runs on for so long."""

PAUSE_SECONDS: Final = 0.1
"""As in `app.client`."""


def _in_thread(
    method: Callable[Concatenate[Client, P], T],
) -> Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]]:
    @functools.wraps(method)
    async def call(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await asyncio.to_thread(method, self.client, *args, **kwargs)

    return call


class AsyncClient:
    """Speaks with one service from coroutines; the parameters are those of `Client`."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        http: httpx2.Client | None = None,
        key: str | None = None,
        retries: int = RETRIES,
    ) -> None:
        self.client = Client(url, http=http, key=key, retries=retries)

    async def __aenter__(self) -> Self:
        """Return itself."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.client.close()

    upload = _in_thread(Client.upload)
    photo = _in_thread(Client.photo)
    photos = _in_thread(Client.photos)
    change_photo = _in_thread(Client.change_photo)
    change_photos = _in_thread(Client.change_photos)
    patches = _in_thread(Client.patches)
    delete_photo = _in_thread(Client.delete_photo)
    job = _in_thread(Client.job)
    jobs = _in_thread(Client.jobs)
    cancel = _in_thread(Client.cancel)
    retry = _in_thread(Client.retry)
    retry_all = _in_thread(Client.retry_all)
    lenses = _in_thread(Client.lenses)
    lens = _in_thread(Client.lens)
    rename_lens = _in_thread(Client.rename_lens)
    choose_model = _in_thread(Client.choose_model)
    merge_lens = _in_thread(Client.merge_lens)
    go_back = _in_thread(Client.go_back)
    save_profile = _in_thread(Client.save_profile)
    add_profile = _in_thread(Client.add_profile)
    save_report = _in_thread(Client.save_report)
    delete_lens = _in_thread(Client.delete_lens)
    calibrations = _in_thread(Client.calibrations)
    lateral_colour = _in_thread(Client.lateral_colour)
    psf = _in_thread(Client.psf)
    kernel = _in_thread(Client.kernel)
    field_png = _in_thread(Client.field_png)
    correct = _in_thread(Client.correct)
    correction = _in_thread(Client.correction)
    corrections = _in_thread(Client.corrections)
    delete_correction = _in_thread(Client.delete_correction)
    download = _in_thread(Client.download)
    account = _in_thread(Client.account)
    export_account = _in_thread(Client.export_account)
    erase_account = _in_thread(Client.erase_account)

    async def wait(
        self,
        work: s.PhotoOut | s.CorrectionOut | s.JobOut | str,
        *,
        timeout: float | None = None,  # noqa: ASYNC109 - one signature with `Client.wait`
        on_change: Callable[[s.JobOut], None] | None = None,
    ) -> s.JobOut:
        """Wait until the work on a photo or a correction has succeeded; see `Client.wait`.

        Raises
        ------
        JobEndedError
            If it failed or was cancelled, or cannot go on before its owner names the lens.
        JobPatienceError
            If it took longer than `timeout` seconds.
        """
        job_id = work if isinstance(work, str) else work.id
        until = None if timeout is None else time.monotonic() + timeout
        tag: str | None = None
        while True:
            left = POLL_SECONDS if until is None else max(until - time.monotonic(), 0.0)
            seconds = 0.0 if tag is None else min(left, POLL_SECONDS)
            job, tag = await asyncio.to_thread(self.client.poll, job_id, tag, seconds)
            if job is not None and ended(job, on_change):
                return job
            if until is not None and time.monotonic() >= until:
                raise JobPatienceError(
                    f"job {job_id} did not end within {timeout:g} s: wait longer or cancel it"
                )
            await asyncio.sleep(PAUSE_SECONDS)  # a service may be set to answer at once
