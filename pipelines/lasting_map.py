"""Maps that outlast a run: which folder a run begins with, and which it leaves behind.

Owns the rules of --load-map, --save-map and --localize. The folder's format is `io.map_folder`.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.config import Config, MappingConfig
from pipelines.errors import ConfigError
from pipelines.io.map_folder import check_map_target, load_map, load_map_objects, save_map
from pipelines.mapping.sparse_map import SparseMap
from pipelines.object_types import ObjectEstimates
from pipelines.types import FrameResult, StereoCamera, TrackingStatus

_log = logging.getLogger("dyob.map")


@dataclass(frozen=True, slots=True)
class LastingMap:
    """The map folders of a run; by default it begins with nothing and leaves no map.

    load: folder of a map to continue, whose world holds. save: folder to write, perhaps the same.
    localize: the loaded map is only read. Raises ConfigError where these do not go together.
    """

    load: Path | str | None = None
    save: Path | str | None = None
    localize: bool = False

    def __post_init__(self) -> None:
        if self.localize and self.load is None:
            raise ConfigError(
                "--localize: expected a map to find the camera in, found none; name its folder "
                "with --load-map"
            )
        if self.localize and self.save is not None:
            raise ConfigError(
                f"--save-map {self.save}: expected a run that may change the map, found "
                "--localize, which leaves it as it is; leave one of the two out"
            )

    def origin(self) -> dict[str, str | bool | None]:
        """What must be the same for an interrupted run to go on."""
        load, save = (None if p is None else str(Path(p).resolve()) for p in (self.load, self.save))
        return {"load": load, "save": save, "localize": self.localize}

    def settings(self, config: Config) -> Config:
        """The settings of the run: no batch against a fixed map, as it would move that map."""
        if not self.localize:
            return config
        return replace(config, batch=replace(config.batch, at_end=False, record=False))

    def open(self, camera: StereoCamera, config: MappingConfig) -> SparseMap | None:
        """The map to begin with, if any; both folders are checked before the run.

        Raises FormatError where there is no map, it is damaged, newer or another camera's, and
        DyObError where the folder to write holds anything but a map.
        """
        if self.save is not None:
            check_map_target(Path(self.save))
        if self.load is None:
            return None
        known = load_map(self.load, camera, config)
        load_map_objects(self.load)
        return known

    def objects(self) -> ObjectEstimates:
        """The objects that were met before this run, as the loaded map tells."""
        return ObjectEstimates.empty() if self.load is None else load_map_objects(self.load)

    def keep(
        self, sparse_map: SparseMap, results: Sequence[FrameResult], earlier: ObjectEstimates
    ) -> None:
        """Write the map with all objects met so far, if it is to be saved.

        earlier: `objects` when the run began, as the map may have been saved in the same folder
        since. Those of this run get numbers after them. Raises DyObError as `save_map`.
        """
        if self.save is None:
            return
        met = [r.objects for r in results if r.status is TrackingStatus.OK]  # else nobody knows
        new = ObjectEstimates.concatenate(ObjectEstimates.empty(), *met)
        new = replace(new, object_id=new.object_id + earlier.object_id.max(initial=0))
        objects = ObjectEstimates.concatenate(earlier, new)
        save_map(self.save, sparse_map, objects)
        _log.info(
            "map saved in %s: %d keyframes, %d objects",
            self.save,
            len(sparse_map.keyframes),
            len(np.unique(objects.object_id)),
        )


def note_start(known: SparseMap | None, localize: bool) -> None:
    """Say in the log which map a run begins with."""
    if known is not None:
        use = "to be localised in; no batch at the end" if localize else "to be continued"
        _log.info("map of %d keyframes loaded, %s", len(known.keyframes), use)


def note_end(known: SparseMap | None, results: Sequence[FrameResult]) -> None:
    """Warn where a run never found itself in the map that it began with."""
    if known is not None and all(r.status is not TrackingStatus.OK for r in results):
        _log.warning("no frame was recognised in the loaded map, so nothing was tracked")
