"""The browser viewer: a page around meshcat's viewer, by itself, or served, or of a run under way.

`scene_html` and `export_scene` make the self-contained page; `RecordedServer` serves a finished
run, and `live.LiveViewer` is the sink that shows one that goes on.
"""

from viz.browser.scene_page import export_scene, scene_html

__all__ = ["export_scene", "scene_html"]
