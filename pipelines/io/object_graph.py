"""Objects that hang together as plain JSON and bytes, and back; no pickle, no code in the data.

Owns the form: which kinds of things may be stored and how each is named. Which classes may, its
callers say. An object that is reached twice is stored once and comes back as one.

A store is a list of nodes and a block of bytes. A value is a number, a string, None, or a
reference: [n] is node n of the same store, [s, n] node n of store s, {"given": name} something that
both sides have. A node is a list of its kind and what belongs to it, arrays lie in the bytes.

Objects are taken apart by `__getstate__` and put together by `__setstate__` or attribute by
attribute, as `copy` does it; their constructors do not run.
"""

from __future__ import annotations

import json
import zipfile
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from types import MethodType
from typing import IO, Any

import numpy as np
from numpy.lib.format import write_array, write_array_header_1_0
from numpy.typing import NDArray

_ALIGNED = 16  # bytes that each array begins at a multiple of
_PLAIN = (bool, int, float, str)
_TREE, _BYTES = "tree", "bytes"

Arrays = dict[str, NDArray]


class Store:
    """Nodes and bytes of some objects, as they are stored."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self._parts: list[bytes | memoryview] = []
        self._size = 0

    def __len__(self) -> int:
        return len(self.nodes)

    def add_bytes(self, content: bytes | memoryview) -> int:
        """Append to the block; returns where it begins. A view of bytes is not copied."""
        at = self._size
        padding = -len(content) % _ALIGNED
        self._parts += [content, bytes(padding)]
        self._size += len(content) + padding
        return at

    def arrays(self, root: Any = None) -> Arrays:
        """All of it as two arrays of bytes. root: a value, which `decode` finds again."""
        block = b"".join(self._parts)
        return {_TREE: self._tree(root), _BYTES: np.frombuffer(block, np.uint8)}

    def save(self, path: Path, root: Any, **more: NDArray) -> None:
        """Write `arrays`, and more of them, as np.savez does, without a copy of the block."""
        with zipfile.ZipFile(path, "w") as archive:
            for name, array in {**more, _TREE: self._tree(root)}.items():
                with _open_array(archive, name) as file:
                    write_array(file, array, allow_pickle=False)
            with _open_array(archive, _BYTES) as file:
                kind = {"descr": "|u1", "fortran_order": False, "shape": (self._size,)}
                write_array_header_1_0(file, kind)
                for part in self._parts:
                    file.write(part)

    def _tree(self, root: Any) -> NDArray[np.uint8]:
        tree = json.dumps([root, self.nodes], separators=(",", ":")).encode()
        return np.frombuffer(tree, np.uint8)


def _open_array(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    return archive.open(f"{name}.npy", "w", force_zip64=True)


class GraphEncoder:
    """Stores objects of some classes, over and over, but what lasts only once.

    classes: that may be stored, by name. given: what both sides have, by name. lasting: classes
    whose objects never change: each goes once into a store of its own that later ones refer to.
    """

    def __init__(
        self,
        classes: Mapping[str, type],
        given: Mapping[str, object],
        lasting: Sequence[type] = (),
        first_store: int = 0,
    ) -> None:
        """first_store: number of the next store of what lasts."""
        self._names = {cls: name for name, cls in classes.items()}
        self._given = {id(thing): name for name, thing in given.items()}
        self._kept: list[object] = [*given.values()]  # so that no other object gets their ids
        self._lasting, self._next_store = tuple(lasting), first_store
        self._known: dict[int, list[int]] = {}  # id of what lasts -> where it is stored

    def encode(self, root: object) -> tuple[Store, Any, Store, int]:
        """The store of an object and its value there; what lasts and is new, and that one's number.

        Raises TypeError for what cannot be stored. Nothing is noted as stored then.
        """
        known, kept = dict(self._known), len(self._kept)
        pass_ = _Pass(self, self._next_store)
        try:
            value = pass_.value(root, pass_.changing)
        except BaseException:
            self._known = known
            del self._kept[kept:]
            raise
        number = self._next_store
        self._next_store += 1 if len(pass_.fresh) else 0
        return pass_.changing, value, pass_.fresh, number


class _Pass:
    """One encoding. changing: the store of what changes. fresh: of what lasts and was not stored.

    memo: (store's id, object's id) -> its node.
    """

    def __init__(self, encoder: GraphEncoder, number: int) -> None:
        self.encoder, self.number = encoder, number
        self.changing, self.fresh = Store(), Store()
        self.memo: dict[tuple[int, int], int] = {}
        self.alive: list[object] = []  # an id is an object's own only while it lives

    def value(self, thing: Any, store: Store) -> Any:
        kind, encoder = type(thing), self.encoder
        if thing is None or kind in _PLAIN:
            return thing
        name = encoder._given.get(id(thing))
        if name is not None:
            return {"given": name}
        stored = encoder._known.get(id(thing))
        if stored is not None:
            return stored
        if kind in encoder._lasting and store is self.changing:
            return self.value(thing, self.fresh)
        key = (id(store), id(thing))
        if key not in self.memo:
            self.alive.append(thing)
            self.memo[key] = n = len(store.nodes)
            store.nodes.append(None)
            store.nodes[n] = self.node(thing, store)
            if store is self.fresh and kind in encoder._names:
                encoder._kept.append(thing)
                encoder._known[id(thing)] = [self.number, n]
                return [self.number, n]
        return [self.memo[key]]

    def node(self, thing: Any, store: Store) -> list[Any]:
        """By the exact type: whatever builds on one of these kinds may be more than it."""
        kinds: dict[type, Callable[[Any, Store], list[Any]]] = {
            np.ndarray: self.array, dict: self.mapping, list: self.items, tuple: self.items,
            set: self.items, deque: self.deque, slice: self.slice, MethodType: self.method,
        }  # fmt: skip
        if type(thing) in kinds:
            return kinds[type(thing)](thing, store)
        if isinstance(thing, np.generic):
            return ["scalar", thing.dtype.str, store.add_bytes(thing.tobytes())]
        name = self.class_name(thing)
        if isinstance(thing, Enum):
            return ["enum", name, thing.value]
        return ["object", name, self.value(thing.__getstate__(), store)]

    def mapping(self, pairs: dict[Any, Any], store: Store) -> list[Any]:
        return ["dict", [[self.value(k, store), self.value(v, store)] for k, v in pairs.items()]]

    def items(self, items: Any, store: Store) -> list[Any]:
        return [type(items).__name__, [self.value(item, store) for item in items]]

    def deque(self, items: deque[Any], store: Store) -> list[Any]:
        return ["deque", [self.value(item, store) for item in items], items.maxlen]

    def slice(self, part: slice, store: Store) -> list[Any]:
        return ["slice", [self.value(end, store) for end in (part.start, part.stop, part.step)]]

    def method(self, method: MethodType, store: Store) -> list[Any]:
        return ["method", self.value(method.__self__, store), method.__name__]

    def array(self, array: NDArray, store: Store) -> list[Any]:
        """Axes in the order in which they lie in memory: rounding may depend on it."""
        if array.dtype.hasobject or array.dtype.names:
            raise TypeError(f"expected an array of numbers or text, found {array.dtype}")
        order = np.argsort([-abs(stride) for stride in array.strides], kind="stable").tolist()
        laid = np.ascontiguousarray(array.transpose(order)) if array.ndim else array
        at = store.add_bytes(laid.reshape(-1).view(np.uint8).data)
        return ["array", array.dtype.str, list(laid.shape), order, at]

    def class_name(self, thing: object) -> str:
        name = self.encoder._names.get(type(thing))
        if name is None:
            kind = type(thing)
            raise TypeError(
                f"expected an object of a class that may be stored, found one of "
                f"{kind.__module__}.{kind.__qualname__}"
            )
        return name


class GraphDecoder:
    """Makes the objects of stores anew.

    classes, given: as of the encoder. stores: by number, as `Store.arrays` made them. Raises
    ValueError where a store is none, and for whatever it names that is not there.
    """

    def __init__(
        self,
        classes: Mapping[str, type],
        given: Mapping[str, object],
        stores: Mapping[int, Mapping[str, NDArray]],
    ) -> None:
        self._classes, self._given = classes, given
        self._lasting = {number: _Reader(self, arrays) for number, arrays in stores.items()}

    def decode(self, arrays: Mapping[str, NDArray]) -> Any:
        """The object that `encode` was given."""
        try:
            reader = _Reader(self, arrays)
            return reader.value(reader.root)
        except (KeyError, IndexError, TypeError, AttributeError) as error:
            raise ValueError(f"its parts do not fit together ({error!r})") from error


class _Reader:
    """One store, and the objects that were made of it so far."""

    def __init__(self, decoder: GraphDecoder, arrays: Mapping[str, NDArray]) -> None:
        self.decoder = decoder
        self.root, self.nodes = json.loads(arrays[_TREE].tobytes())
        self.block = memoryview(arrays[_BYTES].tobytes())
        self.made: dict[int, Any] = {}

    def value(self, stored: Any) -> Any:
        if isinstance(stored, dict):
            return self.decoder._given[stored["given"]]
        if not isinstance(stored, list):
            return stored
        if len(stored) == 2:
            number, n = stored
            return self.decoder._lasting[number].made_of(n)
        return self.made_of(stored[0])

    def made_of(self, n: int) -> Any:
        if n not in self.made:
            kind, *rest = self.nodes[n]
            self.made[n] = getattr(self, f"make_{kind}")(n, *rest)
        return self.made[n]

    def make_array(self, n: int, dtype: str, shape: list[int], order: list[int], at: int) -> Any:
        count = int(np.prod(shape, dtype=np.int64))
        flat = np.frombuffer(self.block, _number_type(dtype), count, at) if count else ()
        laid = np.array(flat, _number_type(dtype)).reshape(shape)
        return laid.transpose(np.argsort(order)) if order else laid

    def make_scalar(self, n: int, dtype: str, at: int) -> Any:
        return np.frombuffer(self.block, _number_type(dtype), 1, at)[0]

    def make_enum(self, n: int, name: str, value: Any) -> Any:
        return self.decoder._classes[name](value)

    def make_method(self, n: int, owner: Any, name: str) -> Any:
        return getattr(self.value(owner), name)

    def make_dict(self, n: int, pairs: list[list[Any]]) -> Any:
        made: dict[Any, Any] = {}
        self.made[n] = made
        made.update((self.value(k), self.value(v)) for k, v in pairs)
        return made

    def make_list(self, n: int, items: list[Any]) -> Any:
        made: list[Any] = []
        self.made[n] = made
        made.extend(self.value(item) for item in items)
        return made

    def make_tuple(self, n: int, items: list[Any]) -> Any:
        return tuple(self.value(item) for item in items)

    def make_set(self, n: int, items: list[Any]) -> Any:
        return {self.value(item) for item in items}

    def make_deque(self, n: int, items: list[Any], maxlen: int | None) -> Any:
        return deque((self.value(item) for item in items), maxlen)

    def make_slice(self, n: int, parts: list[Any]) -> Any:
        return slice(*(self.value(part) for part in parts))

    def make_object(self, n: int, name: str, state: Any) -> Any:
        cls = self.decoder._classes[name]
        made: Any = object.__new__(cls)
        self.made[n] = made
        content = self.value(state)
        if hasattr(cls, "__setstate__"):
            made.__setstate__(content)
            return made
        plain, slots = content if isinstance(content, tuple) else (content, None)
        for attribute, value in {**(plain or {}), **(slots or {})}.items():
            object.__setattr__(made, attribute, value)
        return made


def _number_type(name: str) -> np.dtype:
    dtype = np.dtype(name)
    if dtype.hasobject:
        raise ValueError(f"expected numbers or text, found {name}")
    return dtype
