"""Arrays that lie in files without a name, so that what nobody looks at takes no memory.

Owns where a run keeps what grows with it: the map, its keyframes, the results of frames. They are
used as any other arrays; the system reads them back, page by page, where somebody looks again.
They end with the program, and nothing of them is left on the disk.
"""

from __future__ import annotations

import ctypes
import logging
import mmap
import os
import tempfile
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakSet

import numpy as np
from numpy.typing import DTypeLike, NDArray

_ALIGNED = 16  # bytes that each kept array begins at a multiple of
_FIRST_SLAB, _LARGEST_SLAB = 1 << 20, 1 << 26  # bytes; each is twice the one before
_log = logging.getLogger("dyob.run")

Kept = TypeVar("Kept")


class PagedArrays:
    """Makes arrays in files of a folder; in memory, as any other array, where there is none.

    A disk that refuses costs a warning: arrays are made in memory from then on.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self._maps: WeakSet[mmap.mmap] = WeakSet()  # of the arrays that somebody still has
        self._slab: NDArray[np.uint8] = np.empty(0, np.uint8)  # that is being filled
        self._n_filled = 0

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray:
        """As np.zeros."""
        n_bytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if self.folder is None or n_bytes == 0:
            return np.zeros(shape, dtype)
        try:
            content = _map_file(self.folder, n_bytes)
        except OSError as error:
            _log.warning(
                "%s: expected room for the map, found '%s'; from now on it grows in memory",
                self.folder,
                error.strerror or error,
            )
            self.folder = None
            return np.zeros(shape, dtype)
        self._maps.add(content)
        return np.frombuffer(content, dtype).reshape(shape)

    def grown(self, array: NDArray, n_rows: int) -> NDArray:
        """A copy with so many rows; those that are new are zero."""
        new = self.zeros((n_rows, *array.shape[1:]), array.dtype)
        new[: len(array)] = array
        return new

    def keep(self, thing: Kept) -> Kept:
        """A copy of an array, or of a dataclass with all arrays in it, that nobody will change."""
        if self.folder is None:
            return thing
        kept: Any = thing
        if isinstance(thing, np.ndarray):
            kept = self._keep_array(thing)
        elif is_dataclass(thing):
            parts = {f.name: getattr(thing, f.name) for f in fields(thing)}
            kept = replace(thing, **{name: self.keep(part) for name, part in parts.items()})  # type: ignore[type-var]
        return kept

    def let_go(self) -> None:
        """Free the memory of all that is in files, until somebody looks, and what was freed before.

        The C library hands back what arrays in memory have left between others only when asked.
        """
        for content in self._maps:
            content.madvise(mmap.MADV_DONTNEED)
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)

    def _keep_array(self, array: NDArray) -> NDArray:
        """One after the other in a slab: a file for each small array would be too many."""
        if array.nbytes == 0:
            return array
        begin = -(-self._n_filled // _ALIGNED) * _ALIGNED
        if begin + array.nbytes > len(self._slab):
            size = max(array.nbytes, _FIRST_SLAB, min(2 * len(self._slab), _LARGEST_SLAB))
            self._slab, begin = self.zeros((size,), np.uint8), 0
        self._n_filled = begin + array.nbytes
        kept = self._slab[begin : self._n_filled].view(array.dtype).reshape(array.shape)
        kept[...] = array
        return kept


def _map_file(folder: Path, n_bytes: int) -> mmap.mmap:
    """A new file of zeros, mapped. The disk space is taken now: a full disk must not kill later."""
    with tempfile.TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, n_bytes)
        return mmap.mmap(file.fileno(), n_bytes)
