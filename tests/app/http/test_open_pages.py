"""Open pages: drawn once for all who look at the same one, and never older than the last change."""

from __future__ import annotations

import asyncio
from collections.abc import Hashable

import pytest

from app.http import job_watch
from app.http.job_watch import Watch
from app.http.open_pages import OpenPages


def test_a_change_is_drawn_once_for_all_viewers_of_a_page() -> None:
    state: dict[str, Hashable] = {"anna": 0, "bert": 0}
    drawn: list[str] = []

    def draw() -> dict[str, str]:
        drawn.append("home")
        return {"photos": f"state {state['anna']}"}

    async def look_on(pages: OpenPages, shown: list[str]) -> None:
        with pages.view("anna", "home", "", draw) as view:
            while True:
                shown.append((await view.parts())["photos"])
                if shown[-1] == "state 1":
                    return
                await view.changed(60)

    async def run() -> tuple[list[list[str]], int]:
        pages = OpenPages(Watch(lambda owners: {owner: state[owner] for owner in owners}, every_s=0.01))
        shown: list[list[str]] = [[] for _ in range(50)]
        viewers = [asyncio.create_task(look_on(pages, each)) for each in shown]
        while not all(shown):  # noqa: ASYNC110 - every viewer sees the page as it is
            await asyncio.sleep(0.01)
        state["bert"] = 1  # another's: nobody here hears of it
        state["anna"] = 1
        await asyncio.gather(*viewers)
        return shown, len(pages._pages)

    shown, left = asyncio.run(run())

    assert {each[-1] for each in shown} == {"state 1"}
    assert (
        len(drawn) <= 10
    )  # the page as it was, the first look, the change; a busy machine adds some, not 50
    assert left == 0


def test_what_could_not_be_drawn_is_drawn_again() -> None:
    answers = iter([RuntimeError("the database is away"), {"photos": "here"}])

    def draw() -> dict[str, str]:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def run() -> dict[str, str]:
        with OpenPages(Watch(dict.fromkeys)).view("anna", "home", "", draw) as view:
            with pytest.raises(RuntimeError, match="away"):
                await view.parts()
            return dict(await view.parts())

    assert asyncio.run(run()) == {"photos": "here"}


def test_where_changes_are_told_the_tables_are_looked_at_only_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_watch, "CALM_S", 3600.0)
    looks: list[int] = []

    def look(keys: list[str]) -> dict[str, Hashable]:
        looks.append(len(keys))
        return {key: len(looks) for key in keys}

    async def run() -> None:
        watch = Watch(look, every_s=0.001, announced=lambda: True)
        with watch.of("a job") as waiting:
            await waiting.changed(3600)  # the first look
            await asyncio.sleep(0.1)
            assert len(looks) == 1
            watch.nudge()
            await waiting.changed(3600)
        watch.stop()

    asyncio.run(run())

    assert len(looks) == 2
