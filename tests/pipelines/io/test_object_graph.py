"""Object graphs as arrays: what comes back is what went in, and nothing else can come out."""

from __future__ import annotations

import json
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
import pytest

from pipelines.io.object_graph import GraphDecoder, GraphEncoder
from pipelines.object_types import ObjectState
from pipelines.observations import Tracks


@dataclass(slots=True)
class Box:
    content: object = None
    others: list[object] = field(default_factory=list)


class Open:
    """Without slots, with a method that others may hold."""

    def __init__(self, content: object) -> None:
        self.content = content

    def tell(self) -> object:
        return self.content


CLASSES = {"Box": Box, "Open": Open, "Tracks": Tracks, "State": ObjectState}


def tracks(n: int) -> Tracks:
    return Tracks(np.arange(n), np.ones((n, 2)), np.full(n, np.nan), np.ones(n))


def through(thing: object, given: dict[str, object] | None = None):
    """What comes back after a way through bytes."""
    changing, root, fresh, _ = GraphEncoder(CLASSES, given or {}).encode(thing)
    assert len(fresh) == 0
    return GraphDecoder(CLASSES, given or {}, {}).decode(changing.arrays(root))


@pytest.mark.parametrize(
    "thing",
    [
        None, True, 3, -1.5, 0.1 + 0.2, "naïve", (1, (2.0, None)), {1, 2}, deque([1, 2], 3),
        {5: "a", (1, 2): [3]}, slice(1, None, 2), ObjectState.MOVING, [],
    ],
)  # fmt: skip
def test_plain_things_come_back_as_they_were(thing) -> None:
    again = through([thing])[0]
    assert type(again) is type(thing)
    assert again == thing
    if isinstance(thing, deque):
        assert again.maxlen == thing.maxlen


def test_numbers_that_are_none_and_endless_come_back() -> None:
    nan, inf = through([np.nan, np.inf])
    assert np.isnan(nan)
    assert inf == np.inf


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.empty((0, 4, 4)),
        np.array(3.0),
        np.array(["a", "bcd"]),
        np.array([True, False]),
        np.float32([np.nan, -0.0]),
        np.arange(10)[::3],
    ],
)
def test_arrays_come_back_with_shape_and_type_and_are_free_to_be_changed(array) -> None:
    again = through({"array": array})["array"]
    assert (again.shape, again.dtype) == (array.shape, array.dtype)
    assert again.tobytes() == array.tobytes()
    assert again.flags.writeable
    assert again is not array


def test_axes_keep_their_order_in_memory() -> None:
    """Sums and products round by it."""
    turned = np.arange(24.0).reshape(2, 3, 4).transpose(0, 2, 1)
    fortran = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    again = through([turned, fortran])
    assert again[0].strides == turned.strides
    assert again[1].strides == fortran.strides
    np.testing.assert_array_equal(again[0], turned)


def test_numpys_scalars_stay_numpys() -> None:
    """A float32 array times one of them is of another type than times a plain number."""
    again = through([np.float64(0.1), np.float32(0.1), np.int64(3), np.bool_(True)])
    assert [type(x) for x in again] == [np.float64, np.float32, np.int64, np.bool_]
    assert again == [np.float64(0.1), np.float32(0.1), 3, True]


def test_what_is_one_object_stays_one() -> None:
    shared, array = Box(1), np.ones(3)
    again = through([Box(shared, [array]), Open(shared), array])
    assert again[0].content is again[1].content
    assert again[0].others[0] is again[2]
    again[2][0] = 7
    assert again[0].others[0][0] == 7


def test_objects_that_hold_each_other_come_back() -> None:
    box = Box()
    box.content = Open(box)
    again = through(box)
    assert again.content.content is again


def test_methods_belong_to_the_object_that_came_back() -> None:
    owner = Open("mine")
    owner_again, told = through([owner, owner.tell])
    assert told.__self__ is owner_again
    assert told() == "mine"


def test_what_both_sides_have_is_not_stored() -> None:
    camera = object()
    assert through(Box(camera), {"camera": camera}).content is camera


def test_frozen_objects_come_back_whole() -> None:
    again = through(tracks(3))
    assert isinstance(again, Tracks)
    np.testing.assert_array_equal(again.uv_px, np.ones((3, 2)))


# ------------------------------------------------------------------- lasting


def test_what_lasts_is_stored_once_over_many_encodings() -> None:
    encoder = GraphEncoder(CLASSES, {}, [Tracks])
    history: list[Tracks] = []
    stores, sizes = {}, []
    for n in range(4):
        history.append(tracks(100 + n))
        changing, root, fresh, number = encoder.encode([history, np.arange(n)])
        stores[number] = fresh.arrays()
        sizes.append(len(stores[number]["bytes"]))
    assert list(stores) == [0, 1, 2, 3]
    assert max(sizes) < 1.1 * min(sizes)  # one of them each, not all over again
    again, last = GraphDecoder(CLASSES, {}, stores).decode(changing.arrays(root))
    assert [len(t) for t in again] == [100, 101, 102, 103]
    np.testing.assert_array_equal(last, np.arange(3))


def test_an_encoding_that_fails_notes_nothing_as_stored() -> None:
    encoder = GraphEncoder(CLASSES, {}, [Tracks])
    lasting = tracks(5)
    with pytest.raises(TypeError, match="expected an object of a class that may be stored"):
        encoder.encode([lasting, Counter()])
    changing, root, fresh, number = encoder.encode([lasting])
    again = GraphDecoder(CLASSES, {}, {number: fresh.arrays()}).decode(changing.arrays(root))
    assert len(again[0]) == 5


# ------------------------------------------------------------------- refusal


@pytest.mark.parametrize("thing", [object(), Counter("a"), lambda: 1, b"bytes", 1j, len])
def test_what_is_not_listed_cannot_be_stored(thing) -> None:
    with pytest.raises(TypeError, match="expected an object of a class"):
        through([thing])


def test_arrays_of_objects_cannot_be_stored() -> None:
    with pytest.raises(TypeError, match="numbers or text"):
        through(np.array([object()]))


@pytest.mark.parametrize(
    "nodes",
    [
        [["object", "os.system", "ls"]],  # a class that is not listed
        [["object", "Box", 5]],  # what it holds is no mapping
        [["list", [[7]]]],  # a node that is not there
        [["list", [{"given": "nothing"}]]],
        [["array", "<f8", [1000], [0], 0]],  # more than there are bytes
        [["array", "|O", [1], [0], 0]],
        [["enum", "State", "flying"]],
        [["strange"]],
        [None],
    ],
)
def test_a_store_that_is_none_is_an_error(nodes) -> None:
    tree = np.frombuffer(json.dumps([[0], nodes]).encode(), np.uint8)
    with pytest.raises(ValueError):
        GraphDecoder(CLASSES, {}, {}).decode({"tree": tree, "bytes": np.zeros(16, np.uint8)})
