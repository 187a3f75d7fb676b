"""Vocabularies on disk: each format read from a file written here, the real ones, and bad ones."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.backend import vocabulary_files
from pipelines.backend.vocabulary import Vocabulary
from pipelines.backend.vocabulary_files import SHIPPED, load_vocabulary, save_vocabulary
from pipelines.errors import FormatError

# Parents of nodes 1 to 9 in an order that is not that of the levels, and the leaves' weights.
PARENTS = [0, 1, 1, 0, 2, 2, 4, 4, 4]
WEIGHTS = [0.0, 0.0, 1.5, 0.0, 0.25, 2.5, 3.5, 4.5, 5.5]
BY_LEVEL = [1, 4, 2, 3, 7, 8, 9, 5, 6]  # the same nodes, level by level
N_CHILDREN = [2, 2, 3, 2, 0, 0, 0, 0, 0, 0]
IDF = [1.5, 3.5, 4.5, 5.5, 0.25, 2.5]


@pytest.fixture
def descriptors() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (9, 32), dtype=np.uint8)


def as_text(descriptors: np.ndarray) -> str:
    lines = ["3 3  0 0"]
    for k, (parent, weight) in enumerate(zip(PARENTS, WEIGHTS, strict=True)):
        is_leaf = int(k + 1 not in PARENTS)
        lines.append(f"{parent} {is_leaf} {' '.join(map(str, descriptors[k]))} {weight}")
    return "\n".join(lines) + "\n\n"


def as_yaml(descriptors: np.ndarray, prefix: str = "0 32 ") -> str:
    """As OpenCV writes it; node ids are one hundred more than in the text."""
    lines = ["%YAML:1.0", "vocabulary:", "   k: 3", "   L: 3", "   nodes:"]
    for k, (parent, weight) in enumerate(zip(PARENTS, WEIGHTS, strict=True)):
        above = parent + 100 if parent else 0
        lines.append(f"      - {{ nodeId:{k + 101}, parentId:{above}, weight:{weight},")
        numbers = " ".join(map(str, descriptors[k]))
        lines.append(f'          descriptor:"{prefix}{numbers} " }}')
    lines.append("   words:")
    leaves = [k for k in range(101, 110) if k - 100 not in PARENTS]
    lines += [f"      - {{ wordId:{w}, nodeId:{k} }}" for w, k in enumerate(leaves)]
    return "\n".join(lines) + "\n"


def check_is_the_tree(vocabulary: Vocabulary, descriptors: np.ndarray) -> None:
    assert vocabulary.n_children.tolist() == N_CHILDREN
    assert vocabulary.idf.tolist() == IDF
    assert (vocabulary.centroids[1:] == descriptors[np.array(BY_LEVEL) - 1]).all()


def test_text_of_dbow2_is_read(tmp_path: Path, descriptors) -> None:
    file = tmp_path / "ORBvoc.txt"
    file.write_text(as_text(descriptors))
    check_is_the_tree(load_vocabulary(file), descriptors)


@pytest.mark.parametrize("prefix", ["", "0 32 ", "dbw3 0 32 "])
@pytest.mark.parametrize("packed", [False, True])
def test_yaml_of_dbow_is_read(tmp_path: Path, descriptors, prefix: str, packed: bool) -> None:
    text = as_yaml(descriptors, prefix).encode()
    file = tmp_path / ("words.yml.gz" if packed else "words.yml")
    file.write_bytes(gzip.compress(text) if packed else text)
    check_is_the_tree(load_vocabulary(file), descriptors)


def test_the_own_format_keeps_everything_and_is_the_same_each_time(
    tmp_path: Path, descriptors
) -> None:
    (tmp_path / "v.txt").write_text(as_text(descriptors))
    vocabulary = load_vocabulary(tmp_path / "v.txt")
    for name in ("a.npz", "b.npz"):
        save_vocabulary(vocabulary, tmp_path / name)
    check_is_the_tree(load_vocabulary(tmp_path / "a.npz"), descriptors)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz", "v.txt"]


def test_the_shipped_one_opens_and_is_small() -> None:
    assert 500_000 < SHIPPED.stat().st_size <= 2_000_000
    vocabulary = load_vocabulary()
    assert vocabulary.n_words > 30_000
    assert (vocabulary.branching, vocabulary.depth) == (32, 3)
    assert 0 < np.median(vocabulary.idf) < 10
    assert len(np.unique(vocabulary.centroids[1:], axis=0)) > 0.9 * len(vocabulary.centroids)


def test_the_real_one_of_dbow3_is_read(real_models: Callable[[str], Path]) -> None:
    """Against OpenCV's own reader, and a descent through what that says."""
    file = real_models("dbow3-orb-small/vocabulary.yml.gz")
    vocabulary = load_vocabulary(file)
    assert (vocabulary.n_words, len(vocabulary.n_children)) == (4983, 6163)
    assert (vocabulary.branching, vocabulary.depth) == (10, 5)
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    nodes = storage.getNode("vocabulary").getNode("nodes")
    children: dict[int, list[int]] = {}
    bits, weight = {}, {}
    for row in (nodes.at(k) for k in range(nodes.size())):
        node = int(row.getNode("nodeId").real())
        children.setdefault(int(row.getNode("parentId").real()), []).append(node)
        bits[node] = np.array(row.getNode("descriptor").string().split()[2:], np.uint8)
        weight[node] = row.getNode("weight").real()
    for descriptor in np.random.default_rng(0).integers(0, 256, (50, 32), dtype=np.uint8):
        node = 0
        while node in children:
            node = min(
                children[node], key=lambda k: cv2.norm(bits[k], descriptor, cv2.NORM_HAMMING)
            )
        word = vocabulary.words(descriptor[None])[0]
        assert (vocabulary.centroids[vocabulary.n_children == 0][word] == bits[node]).all()
        assert vocabulary.idf[word] == pytest.approx(weight[node], rel=1e-6)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def damage(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


def test_a_damaged_text_is_one_clear_sentence(tmp_path: Path, descriptors) -> None:
    text, file = as_text(descriptors), tmp_path / "v.txt"
    lines = text.splitlines()
    bad = {
        "a first line other than four numbers": "\n".join(lines[1:]),
        "something other than numbers": damage(text, "\n0 0 ", "\n0 zero "),
        "not 35 for each node": text.rstrip()[:-7],
        "inner nodes without children": "\n".join(lines[:5]),
        "a parent that is no node": damage(text, "\n0 0 ", "\n77 0 "),
        "other than 32 bytes": damage(text, f" {descriptors[0, 3]} ", " 999 "),
        "expected finite weights": damage(text, " 3.5\n", " -3.5\n"),
        "0 numbers": lines[0],
    }
    for words, content in bad.items():
        with pytest.raises(FormatError, match=words) as caught:
            load_vocabulary(write(file, content))
        assert str(caught.value).startswith(f"{file}: expected a vocabulary")
        assert "\n" not in str(caught.value)


def test_a_tree_in_a_circle_is_refused(tmp_path: Path, descriptors) -> None:
    text = damage(as_text(descriptors), "\n1 0 ", "\n5 0 ")  # node 2 hangs on its own child
    text = damage(text, f"\n2 1 {descriptors[4, 0]} ", f"\n2 0 {descriptors[4, 0]} ")
    with pytest.raises(FormatError, match="3 nodes that hang on no root"):
        load_vocabulary(write(tmp_path / "v.txt", text))


def test_a_damaged_yaml_is_one_clear_sentence(tmp_path: Path, descriptors) -> None:
    text, file = as_yaml(descriptors), tmp_path / "v.yml"
    bad = {
        "no nodes in it": "%YAML:1.0\nvocabulary:\n",
        "not the 6 words": text[: text.index("   words:")],
        "nodes without a parent": damage(text, "parentId:104", "parentId:999"),
        "twice the same": damage(text, "nodeId:102,", "nodeId:101,"),
        "numbers as descriptors of 9 nodes": damage(text, f" {descriptors[2, 5]} ", " "),
        "other than 32 bytes of ORB": damage(text, '"0 32 ', '"5 32 '),
        "could not convert": damage(text, "weight:1.5", "weight:none"),
    }
    for words, content in bad.items():
        with pytest.raises(FormatError, match=words) as caught:
            load_vocabulary(write(file, content))
        assert str(caught.value).startswith(f"{file}: expected a vocabulary")
    packed = tmp_path / "v.yml.gz"
    for content in (gzip.compress(text.encode())[:-40], b"not packed at all"):
        packed.write_bytes(content)
        with pytest.raises(FormatError, match=r"v\.yml\.gz: expected a vocabulary"):
            load_vocabulary(packed)


def test_a_damaged_file_of_the_own_format_is_one_clear_sentence(tmp_path: Path) -> None:
    file, whole = tmp_path / "v.npz", SHIPPED.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    for content in (b"", b"PK not a zip", whole[:-5000], flipped):
        file.write_bytes(content)
        with pytest.raises(FormatError, match=r"v\.npz: expected a vocabulary") as caught:
            load_vocabulary(file)
        assert "leave places.vocabulary empty" in str(caught.value)
    with pytest.raises(FormatError, match="No such file"):
        load_vocabulary(tmp_path / "absent.npz")


def test_arrays_that_are_no_vocabulary_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "v.npz"
    good = {
        "version": np.int64(1),
        "centroids": np.zeros((3, 32), np.uint8),
        "n_children": np.array([2, 0, 0], np.int32),
        "idf": np.ones(2, np.float32),
    }
    np.savez(file, **good)
    assert load_vocabulary(file).n_words == 2
    bad = {
        "centroids": np.zeros((3, 31), np.uint8),
        "n_children": np.array([2, 0, 1], np.int32),
        "idf": np.ones(2),
        "version": np.array("one"),
    }
    for name, array in bad.items():
        np.savez(file, **(good | {name: array}))
        with pytest.raises(FormatError, match="expected a vocabulary of ORB words, found"):
            load_vocabulary(file)
    np.savez(file, **(good | {"centroids": np.array([object()])}))
    with pytest.raises(FormatError, match="expected a vocabulary of ORB words, found"):
        load_vocabulary(file)


def test_a_newer_file_says_so(tmp_path: Path, monkeypatch) -> None:
    newer = vocabulary_files.VERSION + 1
    vocabulary = load_vocabulary()
    with monkeypatch.context() as later:
        later.setattr(vocabulary_files, "VERSION", newer)
        save_vocabulary(vocabulary, tmp_path / "v.npz")
    with pytest.raises(FormatError, match=f"found version {newer} of a newer program; update"):
        load_vocabulary(tmp_path / "v.npz")


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"expected a vocabulary as \.npz, .* found '\.bin'"):
        load_vocabulary(tmp_path / "v.bin")
    with pytest.raises(FormatError, match=r"to end in \.npz, found 'v\.yml'"):
        save_vocabulary(load_vocabulary(), tmp_path / "v.yml")
