"""How lasting points looked at first, to be known again where a path returns.

Owns the storage of these pictures. Each hangs on a keyframe, and so follows whatever moves the map.
Who is kept is for `sparse_map` to say, who is looked for for `frontend.map_search`.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from pipelines.paged_arrays import PagedArrays
from pipelines.patches import Patches

Ids = NDArray[np.int64]

_FIRST_CAPACITY = 1024  # pictures; doubled whenever they are full


class PatchAlbum:
    """One patch of each of many points; their T_world_camera lead to a keyframe, not the world."""

    def __init__(self) -> None:
        self._slot: Ids = np.empty(0, np.int64)  # by the point's id, -1 where there is no patch
        self._free: Ids = np.empty(0, np.int64)  # slots of patches that were forgotten
        self._n = 0  # slots that were ever used
        self._arrays = PagedArrays()
        self._columns: dict[str, NDArray] = {
            f.name: getattr(Patches.empty(), f.name) for f in fields(Patches)
        }

    def __len__(self) -> int:
        return self._n - len(self._free)

    def has(self, point_ids: Ids) -> NDArray[np.bool_]:
        """(N,) whether there is a patch of each of these points."""
        return self._slots(point_ids) >= 0

    def add(self, patches: Patches) -> None:
        """Keep patches of points of which there is none yet."""
        n = len(patches)
        if n == 0:
            return
        reused, self._free = self._free[:n], self._free[n:]
        slots = np.concatenate([reused, np.arange(self._n, self._n + n - len(reused))])
        self._n += n - len(reused)
        capacity = len(self._columns["point_ids"])
        if self._n > capacity:
            grown = max(2 * capacity, self._n, _FIRST_CAPACITY)
            for name, column in self._columns.items():
                self._columns[name] = self._arrays.grown(column, grown)
        for name, column in self._columns.items():
            column[slots] = getattr(patches, name)
        last = int(patches.point_ids.max())
        if last >= len(self._slot):
            n = len(self._slot)
            self._slot = self._arrays.grown(self._slot, max(last + 1, 2 * n))
            self._slot[n:] = -1
        self._slot[patches.point_ids] = slots

    def of(self, point_ids: Ids) -> Patches:
        """The patches of those of some points (N,) that have one, by ascending id."""
        slots = self._slots(np.sort(point_ids))
        slots = slots[slots >= 0]
        return Patches(**{name: column[slots] for name, column in self._columns.items()})

    def forget(self, point_ids: Ids) -> None:
        """Drop the patches of points, each named once, where there are any."""
        gone = point_ids[self.has(point_ids)]
        if len(gone):
            self._free = np.concatenate([self._free, self._slot[gone]])
            self._slot[gone] = -1

    def move_into(self, arrays: PagedArrays) -> None:
        """Keep all patches in such arrays from now on."""
        self._arrays = arrays
        self._slot = arrays.grown(self._slot, len(self._slot))
        for name, column in self._columns.items():
            self._columns[name] = arrays.grown(column, len(column))

    def _slots(self, point_ids: Ids) -> Ids:
        slots = np.full(len(point_ids), -1)
        inside = point_ids < len(self._slot)
        slots[inside] = self._slot[point_ids[inside]]
        return slots
