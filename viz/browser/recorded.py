"""The server of a finished run: its page, its data, and its pictures as they are asked for."""

from __future__ import annotations

import asyncio
from pathlib import Path

from pipelines.io.result import Result
from viz.browser import pictures
from viz.browser.page import served_page, to_json
from viz.browser.scene_page import page_data
from viz.browser.server import PageServer, Rules, guarded
from viz.playback import build_playback


class RecordedServer(PageServer):
    """Serves one result folder as it was when this was made.

    Raises DyObError where no port is to be had.
    """

    def __init__(
        self,
        result: Result,
        *,
        host: str | None = None,
        port: int | None = None,
        theme: str = "dark",
    ) -> None:
        super().__init__(host, port)
        playback = build_playback(result)
        data, cloud = page_data(result, playback, theme=theme)
        data["pictures"] = [path is not None for path in playback.pictures]
        self.page = served_page("fetched", theme)
        self.data = to_json(data)
        self.cloud = cloud.message
        self.pictures = playback.pictures

    def picture(self, k: int) -> Path | None:
        """The annotated frame at a position of the playback, where there is one."""
        return self.pictures[k] if 0 <= k < len(self.pictures) else None

    def rules(self) -> Rules:
        from tornado.web import HTTPError, RequestHandler

        @guarded
        class Data(RequestHandler):
            def get(self) -> None:
                self.set_header("Content-Type", "application/json")
                self.finish(self.server.data)

        @guarded
        class Map(RequestHandler):
            def get(self) -> None:
                self.set_header("Content-Type", "application/octet-stream")
                self.finish(self.server.cloud)

        @guarded
        class Picture(RequestHandler):
            async def get(self, k: str) -> None:
                path = self.server.picture(int(k))
                loop = asyncio.get_running_loop()
                data = path and await loop.run_in_executor(
                    None, pictures.read_jpeg, path, *pictures.SERVED
                )
                if not data:
                    raise HTTPError(404)
                self.set_header("Content-Type", "image/jpeg")
                self.finish(data)

        own = {"server": self}
        return [
            *super().rules(),
            (r"/data", Data, own),
            (r"/map", Map, own),
            (r"/picture/(\d{1,9})", Picture, own),
        ]
