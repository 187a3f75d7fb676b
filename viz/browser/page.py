"""The page: our player around meshcat's viewer, as one file that asks for nothing from outside.

Owns how its parts in `page/` are put together. What is shown comes as data; see `records`.
"""

from __future__ import annotations

import json
import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_PARTS = Path(__file__).parent / "page"
_SCRIPTS = ("lines", "frames", "world", "views", "labels", "sources", "player", "main")
_LAYERS = ("map", "camera", "objects", "trails", "labels", "truth", "image")
_HIDDEN = ("truth",)  # layers that a person has to ask for
_ICONS = {
    "first": '<path d="M1 2h2v12H1zM14 2v12L4 8z"/>',
    "back": '<path d="M12 2v12L3 8z"/>',
    "play": '<path d="M4 1.5v13L14 8z"/>',
    "pause": '<path d="M3 2h3.6v12H3zM9.4 2H13v12H9.4z"/>',
    "on": '<path d="M4 2v12l9-6z"/>',
    "last": '<path d="M13 2h2v12h-2zM2 2v12l10-6z"/>',
    "theme": '<path d="M8 1a7 7 0 1 0 0 14A7 7 0 0 0 8 1zm0 12.4V2.6a5.4 5.4 0 0 1 0 10.8z"/>',
}
# Scripts and styles are the page's own, and nothing may be fetched from elsewhere.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
EMBEDDED_POLICY = _POLICY + "img-src data: blob:"
SERVED_POLICY = _POLICY + "img-src 'self' data: blob:; connect-src 'self'"


def served_page(source: str, theme: str = "dark") -> str:
    """The page that asks its server for its data. source: "fetched" or "live"."""
    return _page(source, theme, SERVED_POLICY, "")


def embedded_page(data: dict[str, Any], cloud_base64: str, theme: str = "dark") -> str:
    """The page with all its data in it."""
    # "<" would end the element where a name holds a tag.
    text = to_json(data).replace("<", "\\u003c")
    inside = f'<script type="application/json" id="dyob-data">{text}</script>\n'
    inside += f'<script type="text/plain" id="dyob-map">{cloud_base64}</script>'
    return _page("embedded", theme, EMBEDDED_POLICY, inside)


def to_json(value: Any) -> str:
    """JSON without spaces. Raises ValueError for NaN, which JSON does not know."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _page(source: str, theme: str, policy: str, data: str) -> str:
    parts = _fixed_parts() | {"source": source, "theme": theme, "policy": policy, "data": data}
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read("page.html"))


@cache
def _fixed_parts() -> dict[str, str]:
    parts = {f"icon_{name}": _icon(name, shape) for name, shape in _ICONS.items()}
    parts["style"] = _read("page.css")
    parts["player"] = "\n".join(_read(f"{name}.js") for name in _SCRIPTS)
    parts["layers"] = "\n    ".join(_layer(name) for name in _LAYERS)
    parts["meshcat"] = _meshcat_viewer()
    return parts


def _icon(name: str, shape: str) -> str:
    return f'<svg class="{name}" viewBox="0 0 16 16" aria-hidden="true">{shape}</svg>'


def _layer(name: str) -> str:
    checked = "" if name in _HIDDEN else " checked"
    box = f'<input type="checkbox" id="show-{name}" data-layer="{name}"{checked}>'
    return f'<label id="layer-{name}">{box}{name}</label>'


def _read(name: str) -> str:
    return (_PARTS / name).read_text(encoding="utf-8")


def _meshcat_viewer() -> str:
    """meshcat's viewer with the licences of what is in it, found without importing meshcat."""
    spec = find_spec("meshcat")
    assert spec is not None and spec.origin is not None, "meshcat is a package of [core]"
    viewer = Path(spec.origin).parent / "viewer"
    licence = (viewer / "LICENSE").read_text(encoding="utf-8")
    others = (viewer / "dist" / "main.min.js.LICENSE.txt").read_text(encoding="utf-8")
    script = (viewer / "dist" / "main.min.js").read_text(encoding="utf-8")
    lines = "\n".join(f"// {line}" for line in licence.splitlines())
    return f"// meshcat's viewer:\n{lines}\n{others}\n{script}".replace("</script", "<\\/script")
